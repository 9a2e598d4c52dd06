"""Check the import rules between the packages of src/multidrop, and the pages that name their files."""

from __future__ import annotations

import ast
import re
from collections import Counter
from fnmatch import fnmatch
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from sources import PACKAGE, ROOT, files, parsed, run_time_imports, type_imports
from tables import table

import multidrop

FILES = files("src")
OUTSIDE = {
    *("os", "time", "select", "selectors", "socket", "serial", "termios", "fcntl", "pty", "tty"),
    *("signal", "subprocess"),
}
# packages by layer, the lowest layer first: a package may import only from lower layers
LAYERS = [
    {"errors", "exposition", "printable", "supervisor", "toml_document", "whole_file"},
    {"toml_check"},
    {"core"},
    {"drive"},
    {"families", "modbus_device", "steps"},
    {"planning", "channels"},
    {"transport", "plant"},
    {"control"},
    {"bus"},
    {"polling"},
    {"poller"},
    {"recording", "sim", "scan", "importers", "params"},
    {"capture", "report", "history", "runs", "samples"},
    {"gateway", "fleet"},
    {"cli", "pytest_plugin", "modbus_connection"},
    {"__init__", "__main__"},
]
TOUCHING_THE_SYSTEM = {"transport", "recording", "history", "samples", "sim", "gateway", "fleet", "cli"}
FILES_TOUCHING_THE_SYSTEM = {
    "supervisor.py",
    "whole_file.py",
    "core/process.py",
    "core/port.py",
    "control/eeprom_ledger.py",
    "control/records.py",
    "control/exit_hook.py",
    "control/call.py",
    "params/apply.py",
    "polling/added_rows.py",
    "polling/row_source.py",
    "gateway/http/connections.py",
    "gateway/gateway.py",
    "gateway/mqtt/part.py",
    "gateway/notifications.py",
    "gateway/live/views.py",
}

CLIENTS = {  # packages that import only public names, and the commands that may import these packages
    "gateway": {"cli/serve.py", "cli/completion.py"},
    "fleet": {
        *(f"cli/fleet/{name}.py" for name in ("__init__", "commands", "demo", "services", "setup", "views")),
    },
}
ROOMS = (
    "core",
    "channels",
    "drive",
    "families",
    "plant",
    "transport",
    "control",
    "polling",
    "recording",
    "history",
    "params",
    "samples",
)
OPEN = {
    f"multidrop.{name}"
    for name in (
        *ROOMS,
        "control.commands",
        "samples.sample_tables",
        "errors",
        "exposition",
        "printable",
        "supervisor",
        "toml_check",
        "whole_file",
    )
}
TIED = (  # groups of files whose annotations refer to each other
    {"drive/family.py", "drive/link.py", "drive/verbs.py"},
    {"report/load.py", "report/value_plot.py"},
    {f"gateway/{name}.py" for name in ("gateway", "reload", "metrics", "live/views", "http/routes")},
)
MOST_LINES_OF_A_FILE = 600
MOST_FILES = {"src": 300, "tests": 350}
MOST_FILES_OF_A_FOLDER = 25
IMPORT_OF_A_TEST = re.compile(r"\b(import|from)\b.*\btest_")


def package(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def packages(modules: set[str]) -> set[str]:
    return {name.split(".")[1] for name in modules if name.startswith("multidrop.")}


def layer(name: str) -> int:
    """Return the layer of a package. Public names are above all packages."""
    return next((number for number, names in enumerate(LAYERS) if name in names), len(LAYERS))


def offenders(found: dict[str, set[str]]) -> dict[str, set[str]]:
    return {name: wrong for name, wrong in found.items() if wrong}


def upwards(path: Path, modules: set[str]) -> set[str]:
    others = packages(modules) - {"_core", package(path)}
    if (
        package(path) in CLIENTS
    ):  # these packages are checked by test_gateway_and_fleet_import_only_public_names
        others -= set(multidrop.__all__)
    return {name for name in others if layer(name) >= layer(package(path))}


@pytest.mark.long
def test_every_package_is_in_the_list_of_layers() -> None:
    assert {package(path) for path in FILES} <= set().union(*LAYERS)


@pytest.mark.long
def test_only_core_imports_the_compiled_module() -> None:
    found = {str(path.relative_to(PACKAGE)) for path in FILES if "_core" in packages(run_time_imports(path))}
    assert {name for name in found if not name.startswith("core/")} == set()


@pytest.mark.long
def test_only_listed_files_import_operating_system_modules() -> None:
    outside = {str(path.relative_to(PACKAGE)): run_time_imports(path) & OUTSIDE for path in FILES}
    allowed = {name for name in outside if name.split("/")[0] in TOUCHING_THE_SYSTEM}
    allowed |= FILES_TOUCHING_THE_SYSTEM
    assert offenders({name: found for name, found in outside.items() if name not in allowed}) == {}


@pytest.mark.long
def test_drive_families_import_only_from_the_drive_package() -> None:
    """They may also import errors. The registry and the reader of family files are exceptions."""
    families = PACKAGE / "families"
    paths = {*families.glob("*.py"), *families.glob("profiles/*.py")} - {families / "registry.py"}
    allowed = {"drive", "errors", "families"}
    found = {path.name: packages(run_time_imports(path)) - allowed for path in sorted(paths)}
    assert offenders(found) == {}


@pytest.mark.long
def test_every_import_comes_from_a_lower_layer() -> None:
    found = {str(path.relative_to(PACKAGE)): upwards(path, run_time_imports(path)) for path in FILES}
    assert offenders(found) == {}


@pytest.mark.long
def test_every_type_import_comes_from_a_lower_layer() -> None:
    """This rule applies also to imports for annotations."""
    found = {str(path.relative_to(PACKAGE)): upwards(path, type_imports(path)) for path in FILES}
    assert offenders(found) == {}


@pytest.mark.long
def test_no_import_cycles_between_files() -> None:
    """Imports for annotations count too. Move what two files of a cycle need into a third file below them."""
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


@pytest.mark.long
@pytest.mark.parametrize("client", CLIENTS)
def test_gateway_and_fleet_import_only_public_names(client: str) -> None:
    """So a user could write a program such as the gateway."""
    found = {
        str(path.relative_to(PACKAGE)): {
            name for name in _imported(path) if name.startswith("multidrop.") and not _is_public(name, client)
        }
        for path in FILES
        if package(path) == client
    }
    assert found
    assert offenders(found) == {}


def _is_public(name: str, client: str) -> bool:
    is_own = f"{name}.".startswith(f"multidrop.{client}.")
    return is_own or name in OPEN or name.removeprefix("multidrop.") in multidrop.__all__


@pytest.mark.long
@pytest.mark.parametrize("client", CLIENTS)
def test_only_listed_commands_import_gateway_or_fleet(client: str) -> None:
    found = {str(path.relative_to(PACKAGE)) for path in FILES if client in packages(_imported(path))}
    assert {name for name in found if not name.startswith(f"{client}/")} <= CLIENTS[client]


@pytest.mark.long
def test_no_source_file_is_longer_than_the_limit() -> None:
    """Check that each file keeps the length limit, or is listed with a reason; a longer file has two jobs."""
    lines = {
        path.relative_to(ROOT).as_posix(): len(path.read_text("utf-8").splitlines())
        for path in [*FILES, *files("csrc", suffixes=(".c", ".h"))]
    }
    assert {name for name, count in lines.items() if count > MOST_LINES_OF_A_FILE} == set()


@table("room", MOST_FILES)
def test_src_and_tests_have_few_files(room: str) -> None:
    """Join two files or remove one before a new file would exceed the limit."""
    found = files(room, suffixes=(".py", ".c", ".h"))
    assert 100 < len(found) <= MOST_FILES[room]
    counts = Counter(path.parent for path in found)
    assert {str(folder) for folder, count in counts.items() if count > MOST_FILES_OF_A_FOLDER} == set()


@pytest.mark.long
def test_no_test_imports_another_test() -> None:
    tests = files("tests")
    names = {path.stem for path in tests if path.name.startswith("test_")}
    maybe = [path for path in tests if IMPORT_OF_A_TEST.search(path.read_text("utf-8"))]  # spares parsing
    assert offenders({str(path.relative_to(ROOT)): _imported(path) & names for path in maybe}) == {}


def _imported(path: Path) -> set[str]:
    return run_time_imports(path) | type_imports(path)


@pytest.mark.long
def test_packages_without_io_import_no_clocks_or_ports() -> None:
    """Check that the packages `drive`, `planning` and `channels` import no module for clocks or ports."""
    ports = {"multidrop.core.port", "multidrop.core.capture"}
    outside = OUTSIDE | ports | {"datetime", "random", "threading", "pathlib", "asyncio"}
    pure = [path for path in FILES if package(path) in ("drive", "planning", "channels")]
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
    found = [*(ROOT / "csrc").glob("*.c"), *(ROOT / "csrc" / "posix").glob("*.c")]
    return {path.stem: re.sub(r"/\*.*?\*/", "", path.read_text("utf-8"), flags=re.DOTALL) for path in found}


@pytest.mark.long
def test_no_call_cycles_between_core_files() -> None:
    graph = calls(core())
    assert graph["api"] >= {"engine", "turn"}
    assert graph["port"] >= {"turn", "line"}
    TopologicalSorter(graph).prepare()


@pytest.mark.long
def test_a_cycle_of_calls_is_detected() -> None:
    graph = calls({"a": "int md_a(void)\n{\n    md_b();\n}", "b": "void md_b(void)\n{\n    md_a();\n}"})
    with pytest.raises(CycleError):
        TopologicalSorter(graph).prepare()


@pytest.mark.long
def test_pure_files_of_the_c_core_make_no_system_calls() -> None:
    code = core()
    engine = {"engine", "clock", "wakeup", "port", "rs485", "api", "row_queue", "mastership"}
    graph = calls(code)
    assert offenders({name: graph[name] & engine for name in PURE}) == {}
    assert offenders({name: set(SYSTEM.findall(code[name])) for name in PURE}) == {}


@pytest.mark.long
def test_each_public_function_of_the_core_is_called_from_python() -> None:
    headers = "".join((ROOT / "csrc" / f"{name}.h").read_text("utf-8") for name in HEADERS_OF_PYTHON)
    declared = set(CALLED.findall(re.sub(r"/\*.*?\*/", "", headers, flags=re.DOTALL)))
    called = {
        name for path in files("src") for name in re.findall(r"\blib\.(md_\w+)", path.read_text("utf-8"))
    }
    assert len(declared) > 40
    assert declared - called == set()


@pytest.mark.long
def test_no_c_function_is_longer_than_the_limit() -> None:
    bodies = {
        f"{name}: {head}": body.count("\n") + 1
        for name, text in core().items()
        for head, body in re.findall(r"^(\w[^\n;]*)\n\{\n(.*?)\n\}$", text, re.MULTILINE | re.DOTALL)
    }
    assert len(bodies) > 300
    assert {name: lines for name, lines in bodies.items() if lines > MOST_LINES} == {}


# ---- the architecture page lists every file, and its walkthroughs name existing code ----


ARCHITECTURE = ROOT / "docs" / "reference" / "architecture.md"
WALKS = sorted((ROOT / "docs" / "reference" / "walks").glob("*.md"))
STEP = re.compile(r"`(?:(?:src/multidrop/)?([\w/]+\.py):([\w.]+)|(?:csrc/)?(\w+\.c)(?::(\w+))?)`")
C_FUNCTION = re.compile(r"^[a-z][\w ]*?[ *](\w+)\([^;{]*?\)\s*\{", re.MULTILINE)


def steps(walk: Path) -> list[tuple[str, str]]:
    """Return the steps of a walkthrough: each file with its function or class, or with ""."""
    found = STEP.findall(walk.read_text("utf-8"))
    return [(file or c_file, name or c_name) for file, name, c_file, c_name in found]


def defined(path: Path) -> set[str]:
    """Return the functions of a C file, or the functions and classes of a module.

    The methods of a module's classes are included as `Class.method`.
    """
    if path.suffix == ".c":
        return set(C_FUNCTION.findall(path.read_text("utf-8")))
    names = set()
    for node in parsed(path).body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        if isinstance(node, ast.ClassDef):
            methods = [each for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
            names |= {f"{node.name}.{each.name}" for each in methods}
    return names


def missing(walk: Path) -> list[str]:
    """Return the steps whose file, function or class does not exist."""
    found = []
    for file, name in steps(walk):
        path = (ROOT / "csrc" if file.endswith(".c") else PACKAGE) / file
        if not path.exists() or (name and name not in defined(path)):
            found.append(f"{file}:{name}")
    return found


def test_every_file_has_a_row_on_the_architecture_page() -> None:
    """Check that a row names each file, the folder in which it is, or a pattern that matches it."""
    rows = [line.split("|")[1] for line in ARCHITECTURE.read_text("utf-8").splitlines() if line[:1] == "|"]
    named = {name.rstrip("/") for row in rows for name in re.findall(r"`([^`]+)`", row)}
    csrc = ROOT / "csrc"
    places = [*PACKAGE.iterdir(), *csrc.glob("*.c"), *csrc.glob("posix/*.c"), csrc / "windows"]
    packages = {path.name for path in places if path.name[0] != "_" and path.suffix in ("", ".py", ".c")}
    assert {package for package in packages if not any(fnmatch(package, name) for name in named)} == set()


@table("walk", WALKS, ids=[walk.stem for walk in WALKS])
def test_each_step_of_a_walkthrough_names_existing_code(walk: Path) -> None:
    assert len(steps(walk)) > 8
    assert missing(walk) == []


def test_missing_code_in_a_walkthrough_is_detected(tmp_path: Path) -> None:
    walk = tmp_path / "walk.md"
    walk.write_text(
        "`poller.py:Poller.take_off`, `nowhere.c`, `poller.py:Poller`, `csrc/line.c`, `csrc/line.c:finish`, "
        "`line.c:md_line_gone`"
    )
    assert missing(walk) == ["poller.py:Poller.take_off", "nowhere.c:", "line.c:md_line_gone"]
