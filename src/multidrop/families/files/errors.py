"""The error of a family's file, apart from what reads one: most plants name none."""


class FamilyError(ValueError):
    """All mistakes of a family's file; `mistakes` has a sentence for each: its place, what would be right."""

    def __init__(self, mistakes: tuple[str, ...]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = mistakes
