"""Convert this project's docstrings for Sphinx: paragraphs, lists, indented code, names in backticks.

The docstrings are plain text, so characters that reStructuredText would read as markup are escaped.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import groupby
from typing import Any


def to_rst(lines: list[str]) -> list[str]:
    """Return reStructuredText for a docstring's lines: blank lines separate paragraphs."""
    found: list[str] = []
    for is_blank, group in groupby(lines, key=lambda line: not line.strip()):
        if not is_blank:
            found += [*_paragraph(list(group)), ""]
    return found


def _paragraph(lines: list[str]) -> list[str]:
    """Return a paragraph as reStructuredText; indented lines and tables become literal blocks."""
    if lines[0].startswith((" ", "|")):
        return ["::", "", *(f"    {line}" for line in lines)]
    return list(_with_items(lines))


def _with_items(lines: list[str]) -> Iterator[str]:
    """Yield lines of text; each line that starts with `- ` or `name: ` at the margin starts an item."""
    is_list = False
    for number, line in enumerate(lines):
        begins = re.match(r"- |\w[\w, ]*: ", line) if _is_list(lines) else None
        if begins:
            if not is_list and number:
                yield ""
            is_list = True
            yield "- " + _escaped(line.removeprefix("- "))
        else:
            yield ("  " if is_list else "") + _escaped(line.strip() if is_list else line)


def _is_list(lines: list[str]) -> bool:
    items = [line for line in lines if re.match(r"- |[a-z_]+(, [a-z_]+)*: ", line)]
    return len(items) > 1 or any(line.startswith("- ") for line in lines)


def _escaped(line: str) -> str:
    """Return the line with its names in backticks as code, and all other markup escaped."""
    parts = line.split("`")
    if len(parts) % 2 == 0:  # a name continues on the next line: keep the backtick
        return re.sub(r"([\\*_|`])", r"\\\1", line)
    plain = [re.sub(r"([\\*_|])", r"\\\1", part) for part in parts[::2]]
    code = [f"``{part.strip()}``" if part.strip() else "" for part in parts[1::2]]
    joined = plain[0]
    for name, after in zip(code, plain[1:], strict=True):
        glue = "\\ " if after[:1].isalnum() else ""
        joined += name + glue + after
    return joined


def _process(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = to_rst(lines)


def setup(app: Any) -> dict[str, bool]:
    """Register the hook with Sphinx."""
    app.connect("autodoc-process-docstring", _process)
    return {"parallel_read_safe": True}
