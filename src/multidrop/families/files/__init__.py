"""Load families from files: a register table in TOML and CSV becomes a drive class. No code is run."""


class FamilyError(ValueError):
    """All mistakes in a family file; `mistakes` has a sentence for each: place, error, correction."""

    def __init__(self, mistakes: tuple[str, ...]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
