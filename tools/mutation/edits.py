"""Generate every small mistake (mutant) of a C or Python file, one at a time."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# Only binary operators are matched: in this code, pointers and signs have no space on both sides.
SWAPS = {
    r" == ": (" != ",),
    r" != ": (" == ",),
    r" < ": (" <= ", " >= "),
    r" <= ": (" < ", " > "),
    r" > ": (" >= ", " <= "),
    r" >= ": (" > ", " < "),
    r" \+ ": (" - ",),
    r" - ": (" + ",),
    r" \* ": (" + ",),
    r" /{1,2} ": (" * ",),
    r" % ": (" * ",),
    r" << ": (" >> ",),
    r" >> ": (" << ",),
    r" & ": (" | ",),
    r" \| ": (" & ",),
    r" \^ ": (" | ",),
    r" && ": (" || ",),
    r" \|\| ": (" && ",),
    r" and ": (" or ",),
    r" or ": (" and ",),
    r" is not ": (" is ",),
    r" is (?!not )": (" is not ",),
    r" \+= ": (" -= ",),
    r" -= ": (" += ",),
    r" \|= ": (" &= ",),
    r"\+\+": ("--",),
    r"!(?=[\w(])|\bnot (?!in )": ("",),
    r"(?<=[=(] )-(?=[\w(])|(?<=\()-(?=[\w(])": ("",),
    r"\bmin\(": ("max(",),
    r"\bmax\(": ("min(",),
    r"\bTrue\b": ("False",),
    r"\bFalse\b": ("True",),
}
NUMBER = re.compile(r"(?<![\w.])(?:0x[0-9A-Fa-f]+|[0-9][0-9_]*(?:\.[0-9]+)?)(?![\w.])|'(?:\\?.)'")
FUNCTION = re.compile(r"^ *(?:def|class) (\w+)|^\w[\w \*]*?(\w+)\(", re.MULTILINE)


# a mutant's name: file, function, the line before and after the edit, and `nth`
Name = tuple[str, str, str, str, int]
Edit = tuple[int, int, str]  # start and end offset in the source, replacement


@dataclass(frozen=True)
class Mutant:
    """A source file with one edit. Its name has no line number, so it stays valid if other code changes."""

    path: str
    function: str
    before: str
    after: str
    nth: int  # number among the equal edits in this function, from 1
    number: int  # line number
    text: str  # the whole file's text after the edit

    @property
    def name(self) -> Name:
        return self.path, self.function, self.before, self.after, self.nth

    def __str__(self) -> str:
        return f"{self.path}:{self.number} {self.function}\n  - {self.before}\n  + {self.after}"


def mutants(path: str, source: str) -> list[Mutant]:
    """Return all mutants of a file, in the order of their lines, without duplicates."""
    language = _python if Path(path).suffix == ".py" else _c
    bare, special = language(source)
    found: dict[str, Mutant] = {}
    alike: Counter[tuple[str, str, str]] = Counter()
    for start, end, text in sorted({*_swaps(bare), *_numbers(bare), *special}):
        mutated = source[:start] + text + source[end:]
        if mutated == source or mutated in found:
            continue
        read = _read(source, start, end, mutated)
        alike[read] += 1
        found[mutated] = Mutant(path, *read, alike[read], source.count("\n", 0, start) + 1, mutated)
    return list(found.values())


def _read(source: str, start: int, end: int, mutated: str) -> tuple[str, str, str]:
    """Return the edited function's name, and the edited lines before and after, each joined to one line."""
    first = source.rfind("\n", 0, start) + 1
    last = source.find("\n", end)
    before, after = source[first:last], mutated[first : last + len(mutated) - len(source)]
    names = [match[1] or match[2] for match in FUNCTION.finditer(source, 0, start)]
    return names[-1] if names else "", " ".join(before.split()), " ".join(after.split())


def _swaps(bare: str) -> Iterator[Edit]:
    for pattern, others in SWAPS.items():
        for found in re.finditer(pattern, bare):
            for other in others:
                yield found.start(), found.end(), other


def _numbers(bare: str) -> Iterator[Edit]:
    for found in NUMBER.finditer(bare):
        for change in (1, -1):
            yield found.start(), found.end(), _beside(found[0], change)


def _beside(number: str, change: int) -> str:
    if number.startswith("'"):
        return f"({number} + {change})"
    return str((float(number) if "." in number else int(number, 0)) + change)


def _blank(source: str, spans: list[tuple[int, int]]) -> str:
    for start, end in spans:
        source = source[:start] + re.sub(r"[^\n]", "\0", source[start:end]) + source[end:]
    return source


# ---- C ----


def _c(source: str) -> tuple[str, list[Edit]]:
    """Return the C source with its unmutated parts blanked, and the edits of conditions and statements."""
    outside = r'/\*.*?\*/|"(?:\\.|[^"])*"|^#[^\n]*'
    bare = _blank(source, [match.span() for match in re.finditer(outside, source, re.DOTALL | re.MULTILINE)])
    return bare, [*_c_conditions(bare), *_c_statements(bare)]


def _c_conditions(bare: str) -> Iterator[Edit]:
    for found in re.finditer(r"\b(?:if|while) \(", bare):
        end = _closing(bare, found.end())
        yield found.end(), end, f"!({bare[found.end() : end]})".replace("\0", " ")
    for found in re.finditer(r" \? ", bare):
        start = _beginning(bare, found.start())
        yield start, found.start(), f"!({bare[start : found.start()]})"


def _closing(bare: str, at: int) -> int:
    """Return the position of the parenthesis that closes the one opened before `at`."""
    depth = 1
    while depth:
        depth += {"(": 1, ")": -1}.get(bare[at], 0)
        at += 1
    return at - 1


def _beginning(bare: str, at: int) -> int:
    """Return the start of the condition that ends at `at`."""
    depth = 0
    while True:
        before = bare[:at]
        depth += {")": 1, "(": -1}.get(before[-1], 0)
        if depth < 0 or (depth == 0 and re.search(r"(?:\breturn|[^=!<>]=|[,?:]) $", before)):
            return at
        at -= 1


def _c_statements(bare: str) -> Iterator[Edit]:
    declaration = r"(?:const|static|struct|unsigned|int|size_t|u?int\d+_t|enum)\b"
    statement = rf"^ +(?![ \0]|{declaration}|if\b|for\b|while\b|case\b|default\b|switch\b)([^;{{}}]+);"
    for found in re.finditer(statement, bare, re.MULTILINE):
        if found[1].count("(") == found[1].count(")"):
            yield found.start(1), found.end(1), ""
        if found[1].startswith("return"):
            yield from ((found.start(1), found.end(1), f"return {other}") for other in ("0", "1", "-1"))


# ---- Python ----


def _python(source: str) -> tuple[str, list[Edit]]:
    """Return the Python source with its unmutated parts blanked, and the edits of expressions."""
    starts = [0]
    for line in source.split("\n"):
        starts.append(starts[-1] + len(line) + 1)

    def span(node: ast.AST) -> tuple[int, int]:
        at = [getattr(node, name) for name in ("lineno", "col_offset", "end_lineno", "end_col_offset")]
        return starts[at[0] - 1] + at[1], starts[at[2] - 1] + at[3]

    tree = ast.parse(source)
    constants = [each for each in ast.walk(tree) if isinstance(each, ast.Constant)]
    outside = [span(constant) for constant in constants if isinstance(constant.value, str)]
    for node in ast.walk(tree):
        notes = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        outside += [span(note) for note in notes if note is not None]
    bare = _blank(source, outside)
    bare = _blank(bare, [match.span() for match in re.finditer(r"#.*", bare)])
    edits: list[Edit] = []
    for node in ast.walk(tree):
        tests = [node.test] if isinstance(node, ast.If | ast.While | ast.IfExp) else getattr(node, "ifs", [])
        for start, end in map(span, tests):
            edits.append((start, end, f"(not ({source[start:end]}))"))
        if isinstance(node, ast.FunctionDef):
            edits += [
                (*span(statement), text) for statement in _statements(node) for text in _instead(statement)
            ]
    return bare, edits


def _statements(function: ast.FunctionDef) -> Iterator[ast.stmt]:
    for node in ast.walk(function):
        if isinstance(node, ast.Assign | ast.AugAssign | ast.Return | ast.Break | ast.Continue | ast.Delete):
            yield node
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield node


def _instead(statement: ast.stmt) -> list[str]:
    if not isinstance(statement, ast.Return):
        return ["pass"]
    if not isinstance(statement.value, ast.Constant):
        return ["pass", "return None"]
    return [] if statement.value.value is None else ["pass"]
