"""Check the import rules between rooms (packages of src/multidrop) by parsing the sources."""

from __future__ import annotations

import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from sources import PACKAGE, ROOT, files, run_time_imports, type_imports

import multidrop

pytestmark = pytest.mark.long  # concerns only the package's authors

FILES = files("src")
OUTSIDE = {
    *("os", "time", "select", "selectors", "socket", "serial", "termios", "fcntl", "pty", "tty"),
    *("signal", "subprocess"),
}
# floors, the lowest first: a room may import from itself and from rooms on lower floors
FLOORS = [
    {"errors", "exposition", "extras", "printable", "iso_time", "interpreter", "supervisor"},
    {"toml_check"},
    {"core"},
    {"drive"},
    {"families", "modbus_device", "steps"},
    {"planning"},
    {"transport", "plant"},
    {"control"},
    {"bus"},
    {"polling"},
    {"poller"},
    {"recording", "sim", "scan", "importers", "params"},
    {"capture", "report", "history"},
    {"gateway", "fleet"},
    {"cli", "pytest_plugin"},
    {"__init__", "__main__"},
]
TOUCHING_THE_SYSTEM = {"transport", "recording", "history", "sim", "gateway", "fleet", "cli"}
FILES_TOUCHING_THE_SYSTEM = {
    "supervisor.py",
    "core/fork.py",
    "core/port.py",
    "control/eeprom_ledger.py",
    "control/audit_log.py",
    "control/exit_hook.py",
    "control/latches.py",
    "params/apply.py",
    "gateway/clock.py",
    "gateway/http/connections.py",
    "gateway/gateway.py",
    "gateway/mqtt/part.py",
    "gateway/notifications.py",
    "gateway/sd_notify.py",
    "gateway/live/views.py",
}


CLIENTS = {  # rooms that import only public names, and the commands that import them
    "gateway": {"cli/serve.py"},
    "fleet": {
        *(f"cli/fleet/{name}.py" for name in ("commands", "connection", "drain", "init", "look")),
        *(f"cli/fleet/{name}.py" for name in ("rights", "serve", "watch")),
        "cli/fleet/demo.py",
        "cli/hub.py",
    },
}
ROOMS = (
    "core",
    "drive",
    "families",
    "plant",
    "transport",
    "control",
    "polling",
    "recording",
    "history",
    "params",
)
OPEN = {
    f"multidrop.{name}"
    for name in (
        *ROOMS,
        "control.commands",
        "errors",
        "exposition",
        "extras",
        "printable",
        "supervisor",
        "toml_check",
    )
}
TIED = (  # groups of files whose annotations refer to each other
    {"drive/family.py", "drive/verbs.py"},
    {"polling/batch.py", "polling/tables.py"},
    {"sim/drive.py", "sim/protocol.py"},
    {
        f"gateway/{name}.py"
        for name in ("gateway", "reload", "metrics", "live/views", "live/descriptions", "http/routes")
    },
)
MOST_LINES_OF_A_FILE = 600
IMPORT_OF_A_TEST = re.compile(r"\b(import|from)\b.*\btest_")


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def rooms(modules: set[str]) -> set[str]:
    return {name.split(".")[1] for name in modules if name.startswith("multidrop.")}


def floor(name: str) -> int:
    """Return the floor of a room, or of a public name: public names are above all rooms."""
    return next((number for number, names in enumerate(FLOORS) if name in names), len(FLOORS))


def offenders(found: dict[str, set[str]]) -> dict[str, set[str]]:
    return {name: wrong for name, wrong in found.items() if wrong}


def upwards(path: Path, modules: set[str]) -> set[str]:
    others = rooms(modules) - {"_core", room(path)}
    if room(path) in CLIENTS:  # covered by test_clients_use_only_public_names
        others -= set(multidrop.__all__)
    return {name for name in others if floor(name) >= floor(room(path))}


def test_public_names_are_listed_before_they_are_loaded() -> None:
    assert set(multidrop.__all__) <= set(dir(multidrop))


def test_every_room_has_its_floor() -> None:
    assert {room(path) for path in FILES} <= set().union(*FLOORS)


def test_only_core_imports_the_compiled_module() -> None:
    found = {str(path.relative_to(PACKAGE)) for path in FILES if "_core" in rooms(run_time_imports(path))}
    assert {name for name in found if not name.startswith("core/")} == set()


def test_only_listed_files_use_the_system() -> None:
    outside = {str(path.relative_to(PACKAGE)): run_time_imports(path) & OUTSIDE for path in FILES}
    allowed = {name for name in outside if name.split("/")[0] in TOUCHING_THE_SYSTEM}
    allowed |= FILES_TOUCHING_THE_SYSTEM
    assert offenders({name: found for name, found in outside.items() if name not in allowed}) == {}


def test_families_import_only_drive() -> None:
    families = sorted({*(PACKAGE / "families").glob("*.py")} - {PACKAGE / "families" / "registry.py"})
    found = {path.name: rooms(run_time_imports(path)) - {"drive", "families"} for path in families}
    assert offenders(found) == {}


def test_imports_point_downwards() -> None:
    found = {str(path.relative_to(PACKAGE)): upwards(path, run_time_imports(path)) for path in FILES}
    assert offenders(found) == {}


def test_type_imports_point_downwards() -> None:
    """Imports for annotations, too, come only from rooms below."""
    found = {str(path.relative_to(PACKAGE)): upwards(path, type_imports(path)) for path in FILES}
    assert offenders(found) == {}


def test_no_import_cycles_between_files() -> None:
    """Check for cycles, including imports for annotations. Two such files need a third one below them."""
    ties = {name: min(group) for group in TIED for name in group}
    graph: dict[str, set[str]] = {}
    for path in FILES:
        name = path.relative_to(PACKAGE).as_posix()
        if path.name != "__init__.py":
            modules = {module.removeprefix("multidrop.").replace(".", "/") for module in _imported(path)}
            own = ties.get(name, name)
            graph.setdefault(own, set()).update(ties.get(f"{one}.py", f"{one}.py") for one in modules)
            graph[own].discard(own)
    assert graph["planning/blocks.py"] >= {"planning/bus_time.py"}
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("client", CLIENTS)
def test_clients_use_only_public_names(client: str) -> None:
    """Check that users could write such a client too, because it imports only public names."""
    found = {
        str(path.relative_to(PACKAGE)): {
            name for name in _imported(path) if name.startswith("multidrop.") and not _is_public(name, client)
        }
        for path in FILES
        if room(path) == client
    }
    assert found
    assert offenders(found) == {}


def _is_public(name: str, client: str) -> bool:
    is_own = f"{name}.".startswith(f"multidrop.{client}.")
    return is_own or name in OPEN or name.removeprefix("multidrop.") in multidrop.__all__


@pytest.mark.parametrize("client", CLIENTS)
def test_only_listed_commands_import_a_client(client: str) -> None:
    found = {str(path.relative_to(PACKAGE)) for path in FILES if client in rooms(_imported(path))}
    assert {name for name in found if not name.startswith(f"{client}/")} <= CLIENTS[client]


def test_files_are_short() -> None:
    """Check that each file keeps the length limit, or is listed with a reason; a longer file has two jobs."""
    lines = {
        path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines())
        for path in [*FILES, *files("csrc", suffixes=(".c", ".h"))]
    }
    assert {name for name, count in lines.items() if count > MOST_LINES_OF_A_FILE} == set()


def test_no_test_imports_another_test() -> None:
    tests = files("tests")
    names = {path.stem for path in tests if path.name.startswith("test_")}
    maybe = [path for path in tests if IMPORT_OF_A_TEST.search(path.read_text("utf-8"))]  # spares parsing
    assert offenders({str(path.relative_to(ROOT)): _imported(path) & names for path in maybe}) == {}


def _imported(path: Path) -> set[str]:
    return run_time_imports(path) | type_imports(path)


def test_drive_and_planning_are_pure() -> None:
    """Check that the rooms `drive` and `planning` import no module for clocks or ports."""
    ports = {"multidrop.core.port", "multidrop.core.capture"}
    outside = OUTSIDE | ports | {"datetime", "random", "threading", "pathlib", "asyncio"}
    pure = [path for path in FILES if room(path) in ("drive", "planning")]
    assert offenders({str(path.relative_to(PACKAGE)): _imported(path) & outside for path in pure}) == {}


# ---- the C core ----

DEFINED = re.compile(r"^[a-z][\w ]*?[ *](md_\w+)\([^;{]*?\)\s*\{", re.MULTILINE)
CALLED = re.compile(r"\b(md_\w+)\s*\(")
SYSTEM = re.compile(r"#include <(pthread|sched|time|signal|unistd|poll|termios|sys/\w+)\.h>")
HEADERS_OF_PYTHON = ("multidrop", "capture")
MOST_LINES = 60
PURE = ("body", "frame", "line", "reply", "tcp", "late", "stats", "capture")


def calls(code: dict[str, str]) -> dict[str, set[str]]:
    """Return the files that each C file calls; a function belongs to the first file that defines it."""
    homes: dict[str, str] = {}
    for name, text in code.items():
        for function in DEFINED.findall(text):
            homes.setdefault(function, name)
    return {
        name: {homes[function] for function in CALLED.findall(text) if function in homes} - {name}
        for name, text in code.items()
    }


def core() -> dict[str, str]:
    """Return the text of each C file of the core by name, without comments."""
    found = sorted((ROOT / "csrc").glob("*.c"))
    return {path.stem: re.sub(r"/\*.*?\*/", "", path.read_text("utf-8"), flags=re.DOTALL) for path in found}


def test_no_call_cycles_between_core_files() -> None:
    graph = calls(core())
    assert graph["api"] >= {"engine", "turn"}
    assert graph["port"] >= {"turn", "line"}
    TopologicalSorter(graph).prepare()


def test_a_cycle_of_calls_is_detected() -> None:
    graph = calls({"a": "int md_a(void)\n{\n    md_b();\n}", "b": "void md_b(void)\n{\n    md_a();\n}"})
    with pytest.raises(CycleError):
        TopologicalSorter(graph).prepare()


def test_pure_files_of_the_core_use_no_system() -> None:
    code = core()
    engine = {"engine", "clock", "wakeup", "port", "rs485", "api", "row_queue", "mastership"}
    graph = calls(code)
    assert offenders({name: graph[name] & engine for name in PURE}) == {}
    assert offenders({name: set(SYSTEM.findall(code[name])) for name in PURE}) == {}


def test_python_calls_each_function_of_its_headers() -> None:
    headers = "".join((ROOT / "csrc" / f"{name}.h").read_text("utf-8") for name in HEADERS_OF_PYTHON)
    declared = set(CALLED.findall(re.sub(r"/\*.*?\*/", "", headers, flags=re.DOTALL)))
    called = {
        name for path in files("src") for name in re.findall(r"\blib\.(md_\w+)", path.read_text("utf-8"))
    }
    assert len(declared) > 40
    assert declared - called == set()


def test_no_function_of_the_core_is_long() -> None:
    bodies = {
        f"{name}: {head}": body.count("\n") + 1
        for name, text in core().items()
        for head, body in re.findall(r"^(\w[^\n;]*)\n\{\n(.*?)\n\}$", text, re.MULTILINE | re.DOTALL)
    }
    assert len(bodies) > 300
    assert {name: lines for name, lines in bodies.items() if lines > MOST_LINES} == {}
