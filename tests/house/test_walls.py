"""The house's walls, kept by reading the imports."""

import ast
from pathlib import Path

import pytest

import multidrop

ROOT = Path(multidrop.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
OUTSIDE = {
    "os",
    "time",
    "select",
    "selectors",
    "socket",
    "serial",
    "termios",
    "fcntl",
    "pty",
    "tty",
    "signal",
    "subprocess",
}
# from the ground up: a room imports from itself and from those below it
FLOORS = [
    {"errors", "printable", "interpreter"},
    {"core"},
    {"drive"},
    {"drives"},
    {"planning"},
    {"transport", "plant"},
    {"control"},
    {"bus"},
    {"polling"},
    {"poller"},
    {"recording", "sim", "scan"},
    {"capture", "report"},
    {"cli"},
]
SYSTEM_ROOMS = {"transport", "recording", "sim", "cli"}
TOUCHING_THE_SYSTEM = {
    "core/fork.py",
    "control/eeprom_ledger.py",
    "control/audit_log.py",
    "control/exit_hook.py",
    *(
        str(path.relative_to(ROOT))
        for room in ("transport", "recording", "sim", "cli")
        for path in (ROOT / room).rglob("*.py")
    ),
}


def test_public_names_are_told_before_they_are_used() -> None:
    """Each is loaded when it is asked for the first time."""
    assert set(multidrop.__all__) <= set(dir(multidrop))


def imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found |= {f"{node.module}.{alias.name}" for alias in node.names if node.module == "multidrop"}
    return found


def room(path: Path) -> str:
    return path.relative_to(ROOT).parts[0].removesuffix(".py")


def ours(path: Path) -> set[str]:
    return {name.split(".")[1] for name in imports(path) if name.startswith("multidrop.")}


def floor(name: str) -> int:
    return next((number for number, names in enumerate(FLOORS) if name in names), len(FLOORS))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_only_core_imports_the_compiled_module(path: Path) -> None:
    assert "_core" not in ours(path) or room(path) == "core"


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_only_these_touch_the_system(path: Path) -> None:
    if room(path) not in SYSTEM_ROOMS and str(path.relative_to(ROOT)) not in TOUCHING_THE_SYSTEM:
        assert not imports(path) & OUTSIDE


@pytest.mark.parametrize("path", sorted((ROOT / "drives").glob("*.py")), ids=lambda path: path.stem)
def test_a_family_imports_drive_alone(path: Path) -> None:
    assert ours(path) <= {"drive", "drives"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_downwards(path: Path) -> None:
    if room(path) in ("__init__", "__main__"):
        return
    assert floor(room(path)) < len(FLOORS), f"{room(path)} has no floor yet"
    floors = {name: floor(name) for name in ours(path) - {"_core", room(path)}}
    assert {name for name, above in floors.items() if above >= floor(room(path))} == set()
