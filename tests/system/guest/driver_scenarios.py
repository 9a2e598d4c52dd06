"""Scenarios for every driver: port settings, RTS, failed transfers, stalls, `multidrop doctor`, used ports.

If an adapter is stalled, it accepts no bytes, so its driver keeps the bytes to send.
"""

from __future__ import annotations

import fcntl
import json
import os
import random
import statistics
import struct
import subprocess
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import plug
from common import (
    FAMILY,
    KINDS,
    MODEL,
    Command,
    Meter,
    Poll,
    attempt,
    insist,
    kernel_settings,
    right,
    run,
    until_answered,
    write_plant,
)

import multidrop
from multidrop import Bus, ErmanERG220, Poller
from multidrop.errors import BusError
from multidrop.sim import proof
from multidrop.transport import open_port

TIOCEXCL = 0x540C
NOBODY, DIALOUT = 65534, 20
FRAME = 8  # length in bytes of each request to a simulated motor drive
TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
SERIAL_STRUCT, CLOSING_WAIT = 72, 40  # length of Linux's struct serial_struct, and place of its closing_wait


def _values(path: str, baudrate: int, format: str, **options: Any) -> list[float]:
    with Bus(path, baudrate=baudrate, format=format, **options) as bus:
        meter = bus.attach(Meter, address=2)
        return [meter.read(meter.a), meter.read(meter.b)]


def settings(kind: str, wanted: list[tuple[int, str]]) -> list[dict[str, Any]]:
    """Read at each port setting; return the values, and the settings of kernel and adapter."""
    adapter = plug.Adapter(kind, f"set-{kind}")
    facts = []
    for baudrate, format in wanted:
        read = until_answered(_values, adapter.path, baudrate, format)
        state = adapter.state
        facts.append(
            {
                "read": read,
                "kernel": kernel_settings(adapter.path),
                "adapter": [state["baudrate"], state["format"]],
            }
        )
    return facts


def rts(kind: str, mode: str, baudrate: int, count: int) -> dict[str, Any]:
    """Read while RTS switches a transceiver. Return the adapter's record of RTS changes."""
    adapter = plug.Adapter(kind, f"rts-{kind}", sends_with=int(mode == "rts-up"))
    with Bus(adapter.path, baudrate=baudrate, format="8N1", rs485=mode) as bus:
        meter = bus.attach(Meter, address=2)
        results = Counter(str(attempt(meter.read, meter.a)) for _ in range(count))
    state = adapter.state
    return {
        "results": results,
        "missing": state["rts_missing"],
        "early": sum(lateness < 0 for lateness in state["rts_lateness"]),
        "given up": state["rts_given_up"],
        "lateness": [round(1000 * lateness, 2) for lateness in sorted(state["rts_lateness"])],
        "sent": sum(event["what"] == "sent" for event in state["log"]),
        "levels": [event["rts"] for event in state["log"] if event["what"] == "set"],
    }


def rts_price(kind: str, baudrates: list[int], seconds: float, rounds: int) -> dict[int, dict[str, float]]:
    """Return the median numbers of reads per second, with and without RTS switching."""
    adapter = plug.Adapter(kind, f"price-{kind}", sends_with=1)
    rates: dict[int, dict[str, list[float]]] = {
        baudrate: {mode: [] for mode in ("off", "rts-up", "rts-down")} for baudrate in baudrates
    }
    for baudrate, of_modes in [*rates.items()] * rounds:
        for mode, of_mode in of_modes.items():
            with insist(Bus, adapter.path, baudrate=baudrate, format="8N1", rs485=mode) as bus:
                meter = bus.attach(Meter, address=2)
                insist(meter.read, meter.a)
                good, end = 0, time.monotonic() + seconds
                while time.monotonic() < end:
                    good += not isinstance(attempt(meter.read, meter.b), str)
                of_mode.append(good / seconds)
    return {
        baudrate: {mode: statistics.median(of_mode) for mode, of_mode in of_modes.items()}
        for baudrate, of_modes in rates.items()
    }


def rts_in_stall(kind: str) -> dict[str, Any]:
    """Read while the adapter accepts no bytes; return its record of RTS until after this stall."""
    adapter = plug.Adapter(kind, f"still-{kind}", sends_with=1)

    def record() -> dict[str, Any]:
        state = adapter.state
        sent = sum(event["what"] == "sent" for event in state["log"])
        return {"sent": sent, "rts_given_up": state["rts_given_up"], "rts_missing": state["rts_missing"]}

    with Bus(adapter.path, baudrate=9600, format="8N1", rs485="rts-up") as bus:
        meter = bus.attach(Meter, address=2)
        insist(meter.read, meter.a)
        adapter.do("stall", True)
        results = [str(attempt(meter.read, meter.a)) for _ in range(3)]
        held = record()
    adapter.do("stall", False)
    time.sleep(0.5)  # a request that the driver has kept would be sent now
    return {"results": results, "held": held, "after": record()}


def broken_transfers(kind: str) -> Counter[str]:
    """Read while every fifth transfer to the guest fails with EPROTO, as by noise on a USB cable."""
    adapter = plug.Adapter(kind, f"broken-{kind}")
    results: Counter[str] = Counter()
    with Bus(adapter.path, baudrate=19200, format="8N1") as bus:
        meter = bus.attach(Meter, address=2)
        for number in range(30):
            if number % 5 == 4:
                adapter.do("break_transfers", 1)
            results[str(attempt(meter.read, meter.a))] += 1
    return results


def doctor() -> dict[str, dict[str, list[str]]]:
    """Return the findings of `multidrop doctor` about each adapter and about QEMU's UART, by topic."""
    plug.do("connect", {"serial": "uart"})
    paths = {kind: plug.Adapter(kind, f"doctor-{kind}").path for kind in KINDS} | {"8250": "/dev/ttyS1"}
    commands = {kind: Command("doctor", path, "--json") for kind, path in paths.items()}
    found = {}
    for kind, command in commands.items():
        status, text = command.outcome()
        assert status == 0, f"{kind}: status {status}: {text}"
        findings = json.loads(text)["findings"]
        found[kind] = {finding["topic"]: [finding["what"], finding["advice"]] for finding in findings}
    return found


def lasting_names() -> dict[str, Any]:
    """Return an adapter's link in /dev/serial/by-id, and what two commands write about its path."""
    adapter = plug.Adapter("ftdi", "scanned", family=FAMILY, addresses=[1])
    out = Path("/tmp/scanned.toml")
    out.unlink(missing_ok=True)
    words = ("--model", MODEL, "--addresses", "1", "--quick", "--out", str(out))
    scan = run("scan", adapter.path, *words)
    _, text = run("doctor", adapter.path, "--json")
    findings = {finding["topic"]: finding["advice"] for finding in json.loads(text)["findings"]}
    plant = out.read_text("utf-8") if out.exists() else ""
    return {"by-id": adapter.by_id, "scan": scan, "plant": plant, "advice": findings["adapter"]}


def refused_ports() -> dict[str, tuple[int, str]]:
    """Return what commands say about ports that cannot be opened."""
    adapter = plug.Adapter("ftdi", "busy")
    read = ("read", adapter.path, "erman-er-g-220", "2", "output_frequency")
    with Bus(adapter.path, baudrate=9600, format="8N1"):
        found = {"locked": run(*read), "doctor of locked": run("doctor", adapter.path)}
    fd = os.open(adapter.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    fcntl.ioctl(fd, TIOCEXCL)
    found["exclusive"] = run("doctor", adapter.path, user=NOBODY, groups=[DIALOUT])
    os.close(fd)
    found["no permission"] = run(*read, user=NOBODY)
    found["dialout"] = run("doctor", adapter.path, user=NOBODY, groups=[DIALOUT])
    return found


def absent_uart() -> dict[str, tuple[int, str]]:
    """Return what commands print for /dev/ttyS3, which has no UART, and for ttyS99, which does not exist."""
    found = {"doctor": run("doctor", "/dev/ttyS3")}
    for name in ("ttyS3", "ttyS99"):
        found[name] = run("read", f"/dev/{name}", "erman-er-g-220", "2", "output_frequency")
    return found


def uart(wanted: list[tuple[int, str]]) -> list[dict[str, Any]]:
    """Read two values from QEMU's UART at each setting; return them, and the kernel's settings."""
    plug.do("connect", {"serial": "uart"})
    facts = []
    for baudrate, format in wanted:
        read = attempt(_values, "/dev/ttyS1", baudrate, format)
        facts.append({"read": read, "kernel": kernel_settings("/dev/ttyS1")})
    return facts


def uart_mode(mode: str) -> dict[str, Any]:
    """Read two values while `mode` switches a transceiver; also return the driver's accesses to the UART."""
    plug.do("connect", {"serial": "uart"})
    before = len(plug.do("registers"))
    read = attempt(insist, _values, "/dev/ttyS1", 9600, "8N1", rs485=mode)
    return {"read": read, "registers": plug.do("registers")[before:]}


def rs485_mode() -> dict[str, Any]:
    """Do the same in the driver's RS-485 mode; also return the finding of `multidrop doctor`."""
    subprocess.run(["modprobe", "rs485_uart"], check=True)
    try:
        plug.do("connect", {"serial": "uart"})
        _, text = run("doctor", "/dev/ttyS1", "--json")
        facts = uart_mode("kernel")
    finally:
        subprocess.run(["rmmod", "rs485_uart"], check=True)
    findings = {finding["topic"]: finding["what"] for finding in json.loads(text)["findings"]}
    return {"doctor": findings["RS-485 mode"]} | facts


def stalling_family(kind: str, family: str, seconds: float) -> dict[str, Any]:
    """Read registers of two drives while the adapter stalls and continues; count the results.

    The family is one of multidrop's, or "Meter": a device without `known_counts`, read register by register.
    """
    is_meter = family == "Meter"
    model = Meter if is_meter else getattr(multidrop, family)
    far_end = {} if is_meter else {"family": family, "encoded": True}
    adapter = plug.Adapter(kind, f"shaken-{kind}-{family}", addresses=[1, 2], **far_end)
    chance = random.Random(1)
    counts: Counter[str] = Counter()
    wrong = []
    is_over = threading.Event()

    def shake() -> None:
        while not is_over.wait(chance.uniform(0.1, 1.5)):
            adapter.do("stall", True)
            is_over.wait(chance.choice((0.02, 0.1, 0.3, 0.5, 1.0, 2.0, 3.0)))
            adapter.do("stall", False)

    with Bus(adapter.path) as bus:
        drives = [bus.attach(model, address=address) for address in (1, 2)]
        registers = list(drives[0].readings())[:8]
        thread = threading.Thread(target=shake)
        thread.start()
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            drive, register = chance.choice(drives), chance.choice(registers)
            try:
                value = float(drive.read(register))
            except BusError as failure:
                counts[type(failure).__name__] += 1
            else:
                counts["good"] += 1
                true = right(drive.address, register.address) if is_meter else proof(drive, register)
                if abs(value - true) > 1e-9:
                    wrong.append(f"{drive.address} {register.name}: {value}, not {true}")
        is_over.set()
        thread.join()
    return {"counts": counts, "wrong": wrong}


# ---- stalled adapters ----


def close_only_if_sent(path: str) -> None:
    """Let the driver close this port only when all bytes are sent, instead of after 30 s.

    So a process never ends unless it discards these bytes itself.
    """
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    settings = bytearray(SERIAL_STRUCT)
    fcntl.ioctl(fd, TIOCGSERIAL, settings)
    struct.pack_into("H", settings, CLOSING_WAIT, 0)
    fcntl.ioctl(fd, TIOCSSERIAL, settings)
    os.close(fd)


def end_of_stalled_poll(kind: str, signals: list[int]) -> dict[str, Any]:
    """End a poll by signals, 2 s apart, while its adapter stalls; then let the adapter continue."""
    adapter = plug.Adapter(kind, f"stall-{kind}", family=FAMILY, addresses=[1, 2], encoded=True)
    close_only_if_sent(adapter.path)
    poll = Poll({"a": (adapter.path, [1, 2])})
    poll.wait_for("ok", "a")
    adapter.do("stall", True)
    poll.wait_for("no reply", "a", after=len(poll.rows()))
    begun = time.monotonic()
    for number in signals:
        poll.command.signal(number)
        if number != signals[-1]:
            time.sleep(2)
    status, output = poll.command.outcome()
    seconds = time.monotonic() - begun
    count = len(adapter.state["requests"])
    adapter.do("stall", False)
    time.sleep(2)
    late = adapter.state["requests"][count:]
    return {"status": status, "output": output, "seconds": seconds, "left after the end": late}


def start_in_stall(kind: str) -> dict[str, Any]:
    """Call start and stop during a stall, close the port, and let the adapter continue.

    Return the frames that it still sends, and in `waits` the time limit in s of each wait of `close` for the
    adapter.
    """
    adapter = plug.Adapter(kind, f"held-{kind}", family=FAMILY, addresses=[1])
    close_only_if_sent(adapter.path)
    bus = Bus(adapter.path)
    pump = bus.attach(ErmanERG220, address=1, name="pump")
    insist(pump.set_frequency, 30.0)
    adapter.do("stall", True)
    facts: dict[str, Any] = {"start": str(attempt(pump.start)), "stop": str(attempt(pump.stop, seconds=5))}
    waits: list[float] = []
    close_behind = open_port.close_behind

    def close(fd: int, other: int, seconds: float) -> None:
        waits.append(seconds)
        close_behind(fd, other, seconds)

    open_port.close_behind = close
    begun = time.monotonic()
    bus.close()
    facts |= {"close": time.monotonic() - begun, "waits": waits}
    count = len(adapter.state["requests"])
    adapter.do("stall", False)
    time.sleep(2)
    return facts | {"left after the close": adapter.state["requests"][count:]}


def stop_in_stall(kind: str, seconds: float) -> dict[str, Any]:
    """Stop a drive while the adapter of its polled line stalls.

    Return the stop's result, the frames that are sent after the stall, and the statuses of failed reads.
    """
    adapter = plug.Adapter(kind, f"stop-{kind}", family=FAMILY, addresses=[1, 2])
    stopped: list[str] = []
    with Poller(write_plant({"a": (adapter.path, [1, 2])})) as poller:
        pump = poller["a-1"]
        insist(pump.set_frequency, 30.0)
        adapter.do("stall", True)
        time.sleep(seconds / 2)
        count = len(adapter.state["requests"])
        stopping = threading.Thread(target=lambda: stopped.append(str(attempt(pump.stop))))
        stopping.start()
        time.sleep(seconds / 2)
        adapter.do("stall", False)
        stopping.join()
        misses = poller.summary()["lines"]["a"]["misses"]
    sent = bytes.fromhex("".join(adapter.state["requests"][count:]))
    frames = [sent[at : at + FRAME].hex() for at in range(0, len(sent), FRAME)]
    return {"stop": stopped[0], "frames": frames, "misses": misses}
