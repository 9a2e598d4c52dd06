"""Scenarios: adapters are unplugged, reset or plugged in elsewhere, and replies are damaged."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import select
import signal
import termios
import threading
import time
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import plug
from common import FAMILY, KINDS, Command, Meter, Poll, attempt, insist, run, write_plant

from multidrop import Bus, ErmanERG220
from multidrop.cli import main

USBDEVFS_RESET = 0x5514
WRITES = ("05", "06", "0f", "10")  # function codes


def _encoded(kind: str, serial: str, addresses: list[int], **options: Any) -> plug.Adapter:
    return plug.Adapter(kind, serial, family=FAMILY, addresses=addresses, encoded=True, **options)


def poll_through_unplug(kinds: list[str], names: str) -> dict[str, Any]:
    """Poll one line for each kind; unplug all adapters together, and plug them in again.

    `names` is how the plant names its ports: "path", "by_id" or "by_path".
    """
    addresses = {kind: [KINDS.index(kind) + 1] for kind in kinds}  # an adapter always finds the same drives
    adapters = {kind: _encoded(kind, f"un-{kind}", addresses[kind]) for kind in kinds}
    before = [adapter.tty for adapter in adapters.values()]
    lines = {kind: (getattr(adapters[kind], names), addresses[kind]) for kind in kinds}
    poll = Poll(lines)
    poll.wait_for("ok", kinds)
    for adapter in adapters.values():
        adapter.unplug()
    seen = poll.wait_for("port lost", kinds)
    for adapter in adapters.values():
        adapter.plug_in()
    poll.wait_for("ok", kinds, after=seen)
    return poll.end() | {"same names": before == [adapter.tty for adapter in adapters.values()]}


def commands_while_unplugged(kind: str) -> dict[str, Any]:
    """Call start, set_frequency and stop while the adapter of a running motor is unplugged."""
    adapter = plug.Adapter(kind, f"verbs-{kind}", family=FAMILY, addresses=[1])
    ended: dict[str, str] = {}
    with Bus(adapter.by_id) as bus:
        pump = bus.attach(ErmanERG220, address=1, name="pump")
        insist(pump.set_frequency, 30.0)
        insist(pump.start)
        adapter.unplug()
        count = len(adapter.state["requests"])
        calls = {"start": pump.start, "set_frequency": lambda: pump.set_frequency(20.0)}
        ended = {name: str(attempt(call)) for name, call in calls.items()}
        stopping = threading.Thread(target=lambda: ended.update(stop=str(attempt(pump.stop))))
        stopping.start()
        time.sleep(2)
        was_pending = "stop" not in ended
        adapter.plug_in()
        stopping.join(60)
        state = str(attempt(pump.state))
        sent = adapter.state["requests"][count:]
    writes = [frame for frame in sent if frame[2:4] in WRITES]
    return {"ended": ended, "was pending": was_pending, "state": state, "writes": writes}


def changed_names(how: str) -> dict[str, Any]:
    """Poll adapter `first` while it and `second` are unplugged and come back in the other order."""
    first, second = (_encoded("ftdi", serial, [1, 2]) for serial in ("first", "second"))
    names = [first.tty, second.tty]
    poll = Poll({"a": (getattr(first, how), [1, 2])})
    poll.wait_for("ok", "a")
    for adapter in (first, second):
        adapter.unplug()
    seen = poll.wait_for("port lost", "a")
    count = len(first.state["requests"])
    second.plug_in(first.socket_number)  # `second` now has the tty name and USB socket of `first`
    time.sleep(3)
    alone = len(second.state["requests"])
    first.plug_in(second.socket_number + 1)
    came_back = attempt(poll.wait_for, "ok", "a", after=seen, patience=30.0)
    return poll.end() | {
        "names": names,
        "names after": [first.tty, second.tty],
        "came back": isinstance(came_back, int),
        "requests to the other": [alone, len(second.state["requests"])],
        "requests to it": len(first.state["requests"]) - count,
    }


def other_socket(is_anonymous: bool, names: str) -> dict[str, Any]:
    """Poll through an adapter that is moved to another USB socket and back."""
    adapter = _encoded("ftdi", "moved", [1, 2], is_anonymous=is_anonymous)
    socket_number = adapter.socket_number
    name = getattr(adapter, names)
    poll = Poll({"a": (name, [1, 2])})
    seen = poll.wait_for("ok", "a")
    adapter.unplug()
    seen = poll.wait_for("port lost", "a")
    adapter.plug_in(plug.free_sockets()[-1])
    elsewhere = isinstance(attempt(poll.wait_for, "ok", "a", after=seen, patience=8.0), int)
    adapter.unplug()
    seen = poll.wait_for("port lost", "a")
    adapter.plug_in(socket_number)
    poll.wait_for("ok", "a", after=seen)
    return poll.end() | {"name": name, "elsewhere": elsewhere}


def doctor_without_serial_number() -> dict[str, Any]:
    """Return what `doctor` says about an adapter without serial number, and its /dev/serial links."""
    adapter = plug.Adapter("ftdi", "anonymous", is_anonymous=True)
    _, text = run("doctor", adapter.path, "--json")
    findings = {finding["topic"]: finding for finding in json.loads(text)["findings"]}
    return {"adapter": findings["adapter"], "by_path": adapter.by_path, "path": adapter.path}


def _reset(serial: str) -> None:
    """Reset the USB device under its open port, as a hub does after a disturbance."""
    devices = Path("/sys/bus/usb/devices").glob("*/serial")
    device = next(file.parent for file in devices if file.read_text("utf-8").strip() == serial)
    numbers = [int((device / name).read_text("ascii")) for name in ("busnum", "devnum")]
    node = os.open("/dev/bus/usb/{:03}/{:03}".format(*numbers), os.O_WRONLY)
    fcntl.ioctl(node, USBDEVFS_RESET, 0)
    os.close(node)


def reset_in_poll(kind: str, names: str) -> dict[str, Any]:
    """Reset the adapter during a poll."""
    adapter = _encoded(kind, f"reset-{kind}", [1, 2])
    poll = Poll({"a": (getattr(adapter, names), [1, 2])})
    poll.wait_for("ok", "a")
    _reset(adapter.serial)
    poll.wait_for("ok", "a", after=len(poll.rows()))
    return poll.end()


def reset_in_start(kind: str, delays: list[float]) -> list[dict[str, Any]]:
    """Reset the adapter once for each delay in s after the call of `start`.

    Return each result, and the start's frames on the line.
    """
    adapter = plug.Adapter(kind, f"hub-{kind}", family=FAMILY, addresses=[1])
    facts = []
    name = Path(adapter.by_id)  # the reset may change the tty's name
    for delay in delays:
        plug.wait_until(name.exists)
        with Bus(str(name)) as bus:
            pump = bus.attach(ErmanERG220, address=1, name="pump")
            insist(pump.set_frequency, 30.0)
            count = len(adapter.state["requests"])
            resetting = threading.Timer(delay, _reset, [adapter.serial])
            resetting.start()
            result = str(attempt(pump.start))
            resetting.join()
            time.sleep(1.0)  # a repeated frame would come during this time
            sent = adapter.state["requests"][count:]
            plug.settle()
            stopped = str(attempt(pump.stop, seconds=20))
        writes = [frame for frame in sent if frame[2:4] in WRITES]
        facts.append({"result": result, "writes": writes, "stop": stopped})
    return facts


def damaged_replies(format: str, kinds: list[str]) -> dict[str, Any]:
    """Read while the FTDI chip reports an error in the status of every reply. Then read without errors."""
    adapter = plug.Adapter("ftdi", "damaged")
    with Bus(adapter.path, baudrate=19200, format=format) as bus:
        meter = bus.attach(Meter, address=2)
        facts = {}
        for kind in kinds:
            adapter.do("damage", [kind] * 100)
            facts[kind] = str(attempt(meter.read, meter.a))
            adapter.do("damage", [])
            facts[f"after {kind}"] = str(attempt(meter.read, meter.a))
        ended = bus.statistics().counters.ended
    return facts | {"counts": {str(status): count for status, count in ended.items()}}


def damaged_poll(kind: str, count: int) -> dict[str, Any]:
    """Poll while some replies are damaged; return a summary of the rows, and counts by status."""
    adapter = _encoded("ftdi", "noisy", [1, 2])
    poll = Poll({"a": (adapter.path, [1, 2])})
    poll.wait_for("ok", "a")
    adapter.do("damage", [kind] * count)
    poll.wait_for("bad checksum", "a")
    plug.wait_until(lambda: not adapter.state["damaged"])
    poll.wait_for("ok", "a", after=len(poll.rows()))
    return poll.end() | {"counts": Counter(row["status"] for row in poll.rows())}


SERVE = """
[serve]
listen = "127.0.0.1:18099"
"""


def _get(path: str) -> Any:
    with urllib.request.urlopen(f"http://127.0.0.1:18099{path}", timeout=10) as answer:
        return json.load(answer)


def gateway() -> dict[str, Any]:
    """Unplug and replug the adapter of a gateway; return its reports about line and drive."""
    adapter = _encoded("ftdi", "served", [1, 2])
    serving = Command("serve", write_plant({"a": (adapter.by_id, [1, 2])}, SERVE))
    facts: dict[str, Any] = {}

    def wait_for(moment: str, *, is_ok: bool) -> None:
        def is_there() -> bool:
            assert not serving.is_over(), serving.said
            health = attempt(_get, "/health")
            facts[moment] = health
            return isinstance(health, dict) and (health["lines"]["a"] == "ok") == is_ok

        result = attempt(plug.wait_until, is_there)
        assert result is None, f"{moment}: {facts[moment]}\n{serving.said}"
        facts[f"drive {moment}"] = _get("/api/drive/a-1")

    wait_for("before", is_ok=True)
    adapter.unplug()
    wait_for("unplugged", is_ok=False)
    adapter.plug_in()
    wait_for("after", is_ok=True)
    serving.signal(signal.SIGTERM)
    return facts | {"end": serving.outcome()}


def monitor() -> dict[str, Any]:
    """Unplug and replug the adapter of a `monitor` in a terminal; return its output in the meantime."""
    adapter = _encoded("ftdi", "watched", [1, 2])
    plant = write_plant({"a": (adapter.by_id, [1, 2])})
    child, terminal = pty.fork()
    if child == 0:
        os.environ["TERM"] = "xterm"
        os._exit(main(["monitor", plant]))
    termios.tcsetwinsize(terminal, (40, 120))
    facts: dict[str, Any] = {}

    def watch(moment: str, text: str) -> None:
        """Read the terminal until it shows this text."""
        heard = b""

        def is_shown() -> bool:
            nonlocal heard
            if select.select([terminal], [], [], 0.2)[0]:
                heard += os.read(terminal, 65536)
            return text in heard.decode("utf-8", "replace")

        facts[f"{moment} shown"] = attempt(plug.wait_until, is_shown, 60.0)
        facts[moment] = heard.decode("utf-8", "replace")

    watch("before", "Hz")
    adapter.unplug()
    watch("unplugged", "lost")
    adapter.plug_in()
    watch("after", "Hz")
    os.write(terminal, b"\x03")
    plug.wait_until(lambda: os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT))
    _, status = os.waitpid(child, 0)
    return facts | {"status": os.waitstatus_to_exitcode(status)}
