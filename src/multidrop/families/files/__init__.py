"""Families from files: a register table as TOML and CSV becomes a class of drives. No code is run."""


class FamilyError(ValueError):
    """All mistakes of a family's file; `mistakes` has a sentence for each: its place, what would be right."""

    def __init__(self, mistakes: tuple[str, ...]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
