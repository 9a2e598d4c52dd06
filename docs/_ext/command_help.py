"""The directives `multidrop-help` and `multidrop-models`: the help texts of the command line."""

from __future__ import annotations

import os
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive

from multidrop.cli import COMMANDS, main
from multidrop.cli.fleet import ACTIONS as FLEET
from multidrop.cli.params import ACTIONS as PARAMS
from multidrop.families import MODELS
from multidrop.families.registry import SHIPPED

WIDTH = "92"


def printed(*words: str) -> str:
    """Return the output of a command. Raises RuntimeError if it fails."""
    out = StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = WIDTH
    try:
        with redirect_stdout(out):
            status = main(words)
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before
    if status:
        raise RuntimeError(f"multidrop {' '.join(words)} ended with {status}")
    return out.getvalue()


class Sections(Directive):
    """Adds a section for each name, which shows the output of a command for this name."""

    def run(self) -> list[nodes.Node]:
        found: list[nodes.Node] = []
        for name in self.names():
            section = nodes.section(ids=[f"{self.name}-{name}".replace(" ", "-")], names=[])
            section += nodes.title("", "", nodes.literal("", self.title(name)))
            section += nodes.literal_block("", printed(*self.words(name)), language="text")
            self.state.document.note_explicit_target(section)
            found.append(section)
        return found

    def names(self) -> list[str]:
        raise NotImplementedError

    def title(self, name: str) -> str:
        raise NotImplementedError

    def words(self, name: str) -> list[str]:
        raise NotImplementedError


class Help(Sections):
    """Each command's own help."""

    def names(self) -> list[str]:
        return [
            *COMMANDS,
            *(f"fleet {action}" for action in FLEET),
            *(f"params {action}" for action in PARAMS),
        ]

    def title(self, name: str) -> str:
        return f"multidrop {name}"

    def words(self, name: str) -> list[str]:
        return [*name.split(), "--help"]


class Models(Sections):
    """Each family's register table."""

    def names(self) -> list[str]:
        return [*MODELS, *SHIPPED]

    def title(self, name: str) -> str:
        return name

    def words(self, name: str) -> list[str]:
        return ["models", name]


def setup(app: Any) -> dict[str, bool]:
    """Register the directives with Sphinx."""
    app.add_directive("multidrop-help", Help)
    app.add_directive("multidrop-models", Models)
    return {"parallel_read_safe": True}
