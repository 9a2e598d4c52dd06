"""Lines whose transceiver is switched by RTS or its driver, with a driver that logs its calls.

There is no RS-485 hardware: a preloaded library simulates the driver, and the port is a pseudo-terminal.
tests/c/test_rs485.c checks the times to the nanosecond, on a simulated clock.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from commands import descriptors, threads
from lines import line, plant, polled
from peers import ROOT, preloaded
from toy import Toy

from multidrop.bus import Bus
from multidrop.core import RS485
from multidrop.errors import LineError
from multidrop.plant.loader import PlantError, load_plant
from multidrop.poller import Poller
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import open_port

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the driver is Linux's")
CHARACTER_NS = 1_041_667  # duration of a character at 9600 baud, 8N1
ENABLED, ON_SEND, AFTER_SEND = 1, 2, 4  # linux/serial.h


class Event(NamedTuple):
    ns: int
    what: str
    count: int


CLIENT = """
import json, sys
from patient import be_patient
from toy import Toy
from multidrop.bus import Bus
from multidrop.core import Exchange, Framing, Message, Peer
from multidrop.errors import BusError
from multidrop.sim import Simulator, Wire, simulated
from multidrop.transport import open_port

be_patient(setattr, dict.__setitem__)  # on a busy computer, replies may come late
open_port.is_pseudo_terminal = lambda device: False  # its driver is a UART's
said = []
with Simulator([Wire([simulated(Toy(1))])]) as sim:
    try:
        with Bus(sim.wires[0].path, rs485=sys.argv[1]) as bus:
            toy = bus.attach(Toy, 1)
            for _ in range(int(sys.argv[2])):
                said.append(toy.read(toy.output_current))
            bus.line.drop("the plant file was reloaded")
            bus.line.regain()
            message = Message(0, 0x10, 0x15, 20, data=bytes(40))
            peer = Peer(least_timeout=0.1, most_timeout=0.1)
            settings = {"baudrate": 9600, "format": "8N1", "character": 10 / 9600, "silence": 0.004}
            bus.line.carry_out(Exchange(Framing.RTU, message, peer, **settings))
    except BusError as failure:
        said.append(str(failure))
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(preloaded("rs485_driver", tmp_path_factory.mktemp("driver")))


def play(driver: Path, mode: str, reads: int, **variables: object) -> tuple[list[Any], list[Event]]:
    """Run a client with the simulated driver; return its values or error, and the driver's calls."""
    log = driver.with_name("log")
    log.unlink(missing_ok=True)
    log.touch()
    settings = {"LD_PRELOAD": driver, "RS485_LOG": log, "RS485_CHARACTER_NS": CHARACTER_NS} | variables
    folders = [ROOT / "tests/support" / name for name in ("drives", "simulated")]
    paths = os.pathsep.join(map(str, [*folders, os.environ.get("PYTHONPATH", "")]))
    ran = subprocess.run(
        [sys.executable, "-c", CLIENT, mode, str(reads)],
        env=os.environ | {name: str(value) for name, value in settings.items()} | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    fields = [text.split() for text in log.read_text().splitlines()]
    return json.loads(ran.stdout), [Event(int(ns), what, int(count)) for ns, what, count in fields]


@pytest.mark.long
@pytest.mark.parametrize(
    ("mode", "sending", "receiving"), [("rts-up", "up", "down"), ("rts-down", "down", "up")]
)
def test_rts_switches_only_while_sending(driver: Path, mode: str, sending: str, receiving: str) -> None:
    read, events = play(driver, mode, 20)
    assert len(read) == 20
    writes = [at for at, event in enumerate(events) if event.what == "write"]
    assert len(writes) >= 21
    assert {event.what for event in events[: writes[0] - 1]} == {
        receiving
    }  # RTS does not change before the first request
    late = []
    for at in writes:
        before, write, after = events[at - 1 : at + 2]
        assert (before.what, after.what) == (sending, receiving)
        late.append(after.ns - write.ns - write.count * CHARACTER_NS)
    assert [event.what for event in events].count(sending) == len(writes)  # not while the port is reopened
    assert 0 <= min(late) < 3.5 * CHARACTER_NS  # only the shortest delay: a busy computer prolongs others
    assert events[-1].what == receiving
    assert (
        events[-2].count == 49
    )  # the broadcast was written completely before RTS switched and the port closed


@pytest.mark.long
def test_the_drivers_rs485_mode_is_switched_on_with_its_configured_polarity(driver: Path) -> None:
    for flags in (ON_SEND, AFTER_SEND):
        read, events = play(driver, "kernel", 3, RS485_FLAGS=flags)
        assert len(read) == 3
        assert [event.count for event in events if event.what == "mode"] == [flags | ENABLED] * 2
    _, events = play(driver, "kernel", 1, RS485_FLAGS=0)
    assert [event.count for event in events if event.what == "mode"] == [ON_SEND | ENABLED] * 2


@pytest.mark.long
def test_a_driver_without_rs485_raises_before_any_frame_is_sent(driver: Path) -> None:
    for mode, variables, why in (
        ("kernel", {}, f"has no RS-485 mode ({os.strerror(errno.ENOTTY)})"),
        ("rts-up", {"RS485_CALLS": 0}, f"does not switch RTS ({os.strerror(errno.ENOTTY)})"),
    ):
        (said,), events = play(driver, mode, 1, **variables)
        assert said.endswith(f': the driver {why}, which rs485 = "{mode}" needs')
        assert "write" not in [event.what for event in events]


@pytest.mark.long
def test_port_is_lost_if_rts_can_no_longer_be_switched(driver: Path) -> None:
    said, events = play(driver, "rts-up", 9, RS485_CALLS=6)
    assert said[-1].endswith("its adapter failed")
    broken = [event.what for event in events].index("broken")
    assert "write" in [event.what for event in events[:broken]]
    assert "write" not in [event.what for event in events[broken:]]


def test_a_poller_raises_immediately_if_rts_cannot_be_switched(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_port, "is_pseudo_terminal", lambda device: False)
    with Simulator([Wire([simulated(Toy(1))])]) as sim:
        Bus(sim.wires[0].path).close()  # starts the C core's thread, which then continues to run
        before = descriptors(), threads()
        drive = polled(Toy(1), [Toy.output_current])
        declared = replace(line(sim.wires[0].path, drive), rs485=RS485.RTS_UP)
        with pytest.raises(LineError, match="the driver does not switch RTS"):
            Poller(plant(declared))
        assert (descriptors(), threads()) == before


def test_a_pseudo_terminal_works_without_transceiver_switching() -> None:
    for mode in RS485:
        with Simulator([Wire([simulated(Toy(1))])]) as sim, Bus(sim.wires[0].path, rs485=mode) as bus:
            toy = bus.attach(Toy, 1)
            assert toy.read(toy.output_current) is not None


def test_the_rs485_option_is_refused_for_network_ports_and_unknown_modes() -> None:
    with pytest.raises(ValueError, match='rs485 \'on\' is none of "off", "kernel", "rts-up" and "rts-down"'):
        Bus("/dev/null", rs485="on")
    with pytest.raises(ValueError, match="serial devices only; the port tcp://h is not one, so remove rs485"):
        Bus("tcp://h", rs485="kernel")


PLANT = """
[[line]]
name = "hall"
port = "{}"
rs485 = {}
[[line.drive]]
name = "pump"
model = "innovert-ibd"
address = 1
"""


def test_rs485_is_read_from_a_plant_file(tmp_path: Path) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT.format("/dev/ttyS0", '"rts-down"'))
    loaded = load_plant(path)
    assert loaded.lines[0].rs485 is RS485.RTS_DOWN
    assert loaded.with_ports({"hall": "ports/hall"}).lines[0].rs485 is RS485.RTS_DOWN
    assert loaded.with_ports({"hall": "socket://localhost:4001"}).lines[0].rs485 is RS485.OFF


@pytest.mark.parametrize(
    ("port", "value", "sentence"),
    [
        ("/dev/ttyS0", '"rts"', 'rs485 \'rts\' is none of "off", "kernel", "rts-up" and "rts-down"'),
        ("/dev/ttyS0", "true", 'rs485 = "kernel"'),
        ("socket://10.0.0.7:4001", '"kernel"', "socket://10.0.0.7:4001 is not one, so remove rs485"),
    ],
)
def test_invalid_rs485_option_in_a_plant_file_gives_one_error(
    tmp_path: Path, port: str, value: str, sentence: str
) -> None:
    path = tmp_path / "plant.toml"
    path.write_text(PLANT.format(port, value))
    with pytest.raises(PlantError) as wrong:
        load_plant(path)
    (mistake,) = wrong.value.mistakes
    assert sentence in mistake
