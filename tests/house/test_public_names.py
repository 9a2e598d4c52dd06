"""Check the public names: they are listed once, load lazily, have a readable repr, and are strictly typed."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module
from importlib.metadata import version
from inspect import signature
from pathlib import Path
from pydoc import plaintext, render_doc
from traceback import format_exception

import pytest
from batches import example
from toy import Toy

import multidrop
from multidrop import Bus, Plant, Poller
from multidrop.core import Framing, NumberFormat
from multidrop.drive import DISCRETE, HOLDING, INPUT, Kept

NAMES = [name for name in multidrop.__all__ if name != "__version__"]


def run(*words: str) -> str:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True).stdout


def test_public_name_is_its_modules_object() -> None:
    for name in NAMES:
        home = import_module(multidrop._HOMES[name])
        assert getattr(multidrop, name) is getattr(home, name)
        assert name in dir(multidrop)


def test_no_name_is_listed_twice() -> None:
    stub = Path(multidrop.__file__).with_suffix(".pyi").read_text()
    imports = [line for line in stub.splitlines() if line.startswith("from ")]
    assert len(imports) == len(NAMES)
    assert len(set(NAMES)) == len(NAMES)


def test_unknown_name_raises_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'multidrop' has no attribute 'Buss'"):
        _ = multidrop.Buss  # type: ignore[attr-defined]


def test_modules_load_on_first_use() -> None:
    code = (
        "import sys, multidrop; print(sorted(name for name in sys.modules if name.startswith('multidrop')))"
    )
    assert run("-c", code).strip() == str(["multidrop", "multidrop.interpreter"])


def test_version_is_the_distribution_version() -> None:
    assert multidrop.__version__ == version("multidrop")


def test_package_runs_as_a_module() -> None:
    assert "usage: multidrop" in run("-m", "multidrop", "--help")


def test_family_is_declared_with_public_names() -> None:
    """Declare a user's own family with public names only."""

    class Own(multidrop.Drive):
        speed = multidrop.reading(1, "Hz", step=0.1, table=INPUT, number_format=NumberFormat.I16)
        level = multidrop.setting(2, kept=Kept.RAM, table=HOLDING)
        lamp = multidrop.reading(3, number_format=NumberFormat.BIT, table=DISCRETE)

    assert Own(1, framing=Framing.RTU).speed is Own.speed


# ---- repr in a debugger ----


def test_repr_of_drive_and_bus() -> None:
    drive = Toy(3, name="pump-3")
    assert repr(drive) == "<Toy 'pump-3', address 3, rtu, 9600 8N1, not attached>"
    with Bus("loop://") as bus:
        assert repr(bus) == "<Bus loop://: no drives>"
        bus.attach(drive)
        assert repr(drive) == "<Toy 'pump-3', address 3, rtu, 9600 8N1, on loop://>"
        assert repr(bus) == "<Bus loop://: pump-3>"
    assert repr(bus) == "<Bus loop://, closed: pump-3>"


def test_repr_of_batch() -> None:
    assert repr(example()) == "<Batch: 5 rows of 3 drives, 3.000 s from 2026-11-21T09:30:00.123+00:00>"


def test_repr_of_poller() -> None:
    poller = Poller(Plant((), Path()))
    assert repr(poller) == "<Poller not started; no lines>"
    poller.close()
    assert repr(poller) == "<Poller closed; no lines>"


# ---- completion at a prompt ----


def test_package_has_few_names_and_dir_lists_only_these() -> None:
    assert len(NAMES) <= 45
    assert dir(multidrop) == sorted(multidrop.__all__)


def test_help_of_a_verb_has_its_signature() -> None:
    shown = render_doc(multidrop.YD1000.start, renderer=plaintext)
    assert "start(self, direction: " in shown
    assert str(signature(Toy(1).stop)) == "()"


def test_a_missing_port_is_one_sentence() -> None:
    with pytest.raises(multidrop.LineError, match="/dev/ttyUSB77: there is no such port") as caught:
        Bus("/dev/ttyUSB77")
    lines = "".join(format_exception(caught.value))
    assert "The above exception" not in lines
    assert "During handling" not in lines


# ---- strict typing ----


ROOT = Path(__file__).parents[2]


PAGES = [ROOT / "README.md", ROOT / "docs" / "howto" / "coming-from.md"]


SCRIPTS = {
    **{
        page.stem.replace("-", "_"): "".join(
            re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)
        )
        for page in PAGES
    },
    **{path.stem: path.read_text("utf-8") for path in (ROOT / "examples").glob("*.py")},
}


TYPES = """
from multidrop import Bus, InnovertIBD

with Bus("/dev/ttyUSB0") as bus:
    pump = bus.attach(InnovertIBD, address=1)
    reveal_type(pump.read(pump.output_current))
    reveal_type(pump.read("output_current", pump.output_frequency))
    reveal_type(pump.write(pump.acceleration_time, 20.0))
    reveal_type(pump.stop(seconds=5).ok)
    reveal_type(pump.state())
    pump.write(pump.acceleration_time, "fast")
    pump.red("output_current")
"""


FOUND = [
    'note: Revealed type is "float"',
    'note: Revealed type is "dict[str, Any]"',
    'note: Revealed type is "float"',
    'note: Revealed type is "bool"',
    'note: Revealed type is "multidrop.drive.state.State"',
    'error: No overload variant of "write" of "RegisterAccess"',
    'error: "InnovertIBD" has no attribute "red"',
]


def mypy(folder: Path) -> str:
    """Return mypy's output for the scripts in a user's folder."""
    words = ["--strict", "--follow-imports=silent", "--config-file=", f"--cache-dir={folder / 'cache'}", "."]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *words],
        cwd=folder,
        env={"MYPYPATH": str(ROOT / "src")},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    return done.stdout + done.stderr


@pytest.mark.long
def test_scripts_of_users_are_strictly_typed(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    for name, script in SCRIPTS.items():
        (tmp_path / f"{name}.py").write_text(script, "utf-8")
    found = mypy(tmp_path)
    assert found.startswith("Success"), found


@pytest.mark.long
def test_values_have_the_types_of_their_registers(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    (tmp_path / "script.py").write_text(TYPES, "utf-8")
    found = mypy(tmp_path)
    for sentence in FOUND:
        assert sentence in found
