"""Load drive families from files. A register table in TOML and CSV becomes a drive class. No code is run."""


class FamilyError(ValueError):
    """Raised for a family file with mistakes; `mistakes` has a sentence with the correction for each."""

    def __init__(self, mistakes: tuple[str, ...]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
