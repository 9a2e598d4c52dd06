"""The directive `public-names`: a package's public names, documented from their docstrings.

    ```{public-names} multidrop
    Bus Poller
    ```

documents these names. With the option `:rest:` instead of names, it documents all public names of the package
that no earlier directive on the page has documented.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive, directives
from docutils.statemachine import StringList

import multidrop


def public(package: ModuleType) -> list[str]:
    """Return a package's public names: `__all__`, or the names that its file defines or re-exports."""
    if hasattr(package, "__all__"):
        return list(package.__all__)
    tree = ast.parse(Path(str(package.__file__)).read_text("utf-8"))
    return [name for node in tree.body for name in _defined(node) if not name.startswith("_")]


def _defined(node: ast.stmt) -> Iterator[str]:
    if isinstance(node, ast.ImportFrom):
        yield from (alias.name for alias in node.names if alias.asname == alias.name)
    elif isinstance(node, ast.FunctionDef | ast.ClassDef):
        yield node.name
    elif isinstance(node, ast.Assign):
        yield from (target.id for target in node.targets if isinstance(target, ast.Name))


IN_PARTS = {"Drive", "Poller"}  # classes that are documented with the members of their base classes
INTERNAL = "forked, leave, part, tended, peer, peers"  # undocumented: only other rooms call these methods


class PublicNames(Directive):
    """Documents public names of the package in the argument."""

    required_arguments = 1
    has_content = True
    option_spec = {"rest": directives.flag}

    def run(self) -> list[nodes.Node]:
        package = import_module(self.arguments[0])
        env = self.state.document.settings.env
        seen: set[str] = env.temp_data.setdefault(f"public-names {package.__name__}", set())
        names = " ".join(self.content).split()
        if unknown := set(names) - set(public(package)):
            raise self.error(f"{package.__name__} has no public {', '.join(sorted(unknown))}")
        if "rest" in self.options:
            names += [name for name in public(package) if name not in seen]
        seen.update(names)
        again = [name for name in names if package is not multidrop and _is_in_multidrop(package, name)]
        own = [name for name in names if name not in again]
        lines = ["```{eval-rst}", *(line for name in own for line in _documented(package, name)), "```"]
        if again:
            lines += ["", f"From `multidrop`, and the same here: {', '.join(f'`{name}`' for name in again)}."]
        node = nodes.container()
        self.state.nested_parse(StringList(lines, "public-names"), self.content_offset, node)
        return node.children


def _is_in_multidrop(package: ModuleType, name: str) -> bool:
    return name in public(multidrop) and getattr(multidrop, name) is getattr(package, name)


def _documented(package: ModuleType, name: str) -> list[str]:
    found: Any = getattr(package, name)
    place = f"{package.__name__}.{name}"
    if inspect.isclass(found) and issubclass(found, BaseException):
        return [f".. autoexception:: {place}", "   :show-inheritance:", ""]
    if inspect.isclass(found):
        bases = ["   :inherited-members:"] if name in IN_PARTS else []
        return [f".. autoclass:: {place}", "   :members:", *bases, f"   :exclude-members: {INTERNAL}", ""]
    if inspect.isfunction(found):
        return [f".. autofunction:: {place}", ""]
    return [f".. py:data:: {place}", f"   :value: {found!r}", ""]


def setup(app: Any) -> dict[str, bool]:
    """Register the directive with Sphinx."""
    app.add_directive("public-names", PublicNames)
    return {"parallel_read_safe": True}
