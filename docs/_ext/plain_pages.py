"""Convert plain Markdown pages for Sphinx: add tables of contents, and the documentation of public names."""

from __future__ import annotations

import re
from typing import Any

_SECTION = re.compile(r"^## (.+)\n\n((?:- \[.*\]\(.*\.md\)\n)+)", re.MULTILINE)
_NAMES = re.compile(
    r"^<!-- public-names ([\w.]+)(: all others)? -->\n((?:\n?(?:- `\w+`.*\n(?:  .*\n)*)+)?)", re.MULTILINE
)


def with_contents(text: str) -> str:
    """Return a page with a hidden table of contents for each section that is a list of links."""
    tables = ["```{toctree}\n:hidden:\n\ntutorial\n```\n"]
    for title, links in _SECTION.findall(text):
        pages = "\n".join(re.findall(r"\((.*)\.md\)", links))
        tables.append(f"```{{toctree}}\n:caption: {title}\n:hidden:\n\n{pages}\n```\n")
    return "\n".join([text, *tables])


def with_names(text: str) -> str:
    """Return a page in which the documentation of public names replaces each list of such names."""
    return _NAMES.sub(_directive, text)


def _directive(found: re.Match[str]) -> str:
    package, others, listed = found.groups()
    names = ":rest:" if others else " ".join(re.findall(r"^- `(\w+)`", listed, re.MULTILINE))
    return f"```{{public-names}} {package}\n{names}\n```\n"


def _on_source(app: Any, page: str, source: list[str]) -> None:
    source[0] = with_contents(source[0]) if page == "index" else with_names(source[0])


def setup(app: Any) -> dict[str, bool]:
    """Register the conversion with Sphinx."""
    app.connect("source-read", _on_source)
    return {"parallel_read_safe": True}
