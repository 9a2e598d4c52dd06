"""Sparkplug B: an edge node whose devices are the drives.

The node publishes births, deaths, changed values, and a rebirth on request.

Source: Eclipse Sparkplug specification 3.0.0, section 5 (birth, death, rebirth).
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, NamedTuple

from multidrop import Drive, Plant, Register
from multidrop.control import CommandResult
from multidrop.gateway.commands import drives_of
from multidrop.gateway.live.hub import SILENT, published_values
from multidrop.gateway.mqtt.broker import Publication
from multidrop.gateway.mqtt.broker_commands import BrokerCommands
from multidrop.gateway.mqtt.settings import MqttSettings
from multidrop.gateway.mqtt.sparkplug_payload import (
    DataType,
    Metric,
    ReceivedMetric,
    Value,
    payload,
    read_command,
)
from multidrop.gateway.parts import PartContext

NAMESPACE = "spBv1.0"
REBIRTH = "Node Control/Rebirth"
BIRTH_DEATH = "bdSeq"
SEQUENCES = 256  # the counters seq and bdSeq run from 0 to 255, and then start again

STATE, FAULT, STOP = "state", "fault", "Device Control/Stop"
OWN = (STATE, FAULT)  # names of the two text metrics that every drive has
REGISTERS = "registers/"  # prefix of the metric of a register that is itself called "state" or "fault"
MOST_PAST = 500  # limit of historical values in flight
_log = logging.getLogger("multidrop.gateway.mqtt.part")


class PastValue(NamedTuple):
    """A register's earlier value and its time, to be sent as a historical value."""

    drive: str
    register: str
    time_ms: int
    value: Value


class SparkplugNode:
    """A Sparkplug edge node whose devices are the drives. Values are sent when they change."""

    kind = "sparkplug"

    def __init__(self, settings: MqttSettings, context: PartContext, utc_ms: Callable[[], int]) -> None:
        self.outbox: Any = None
        self._settings = settings
        self._context = context
        self._hub = context.hub
        self._plant = context.plant
        self._utc_ms = utc_ms
        self._node = settings.node or context.plant.path.stem
        self._commands = BrokerCommands(context.commands, settings.caller, utc_ms, self._report)
        self._birth = -1  # the node's bdSeq (birth/death sequence number)
        self._seq = 0
        # values sent last, by drive; only for drives whose birth was sent and whose death was not
        self._sent: dict[str, dict[str, Value]] = {}
        # values that changed since the last message, and their times in ms
        self._changed: dict[str, dict[str, tuple[Value, int]]] = {}
        self._past: dict[str, list[PastValue]] = {}  # historical values to be sent with the next messages
        self._aliases: dict[tuple[str, str], int] = {}

    def _topic(self, kind: str, *device: str) -> str:
        return "/".join((NAMESPACE, self._settings.sparkplug, kind, self._node, *device))

    # ---- the methods of Messages ----

    def will(self) -> Publication:
        self._birth = (self._birth + 1) % SEQUENCES
        return Publication(self._topic("NDEATH"), self._death, qos=1)

    def topics(self) -> list[tuple[str, int]]:
        listened = [(self._topic("NCMD"), 1)]
        return [*listened, (self._topic("DCMD", "+"), 1)] if self._settings.commands else listened

    def connected(self) -> None:
        self._sent.clear()
        self._changed.clear()
        self.outbox.put(Publication(self._topic("NBIRTH"), self._node_birth, qos=0))
        self.publish()

    def received(self, topic: str, payload: bytes, *, is_retained: bool) -> None:
        levels = topic.split("/")
        if levels[2:3] != ["NCMD"] and not (levels[2:3] == ["DCMD"] and self._settings.commands):
            _log.warning("the broker sent a command, but commands are off: %.100r", topic)
            return
        try:
            sent_ms, metrics = read_command(payload)
        except ValueError as mistake:
            _log.warning("a command on %s is not a Sparkplug payload: %s", topic, mistake)
            if levels[2] == "DCMD" and STOP.encode() in payload:  # an invalid message must not prevent a stop
                self._commands.stop([levels[-1]])
            return
        if levels[2] == "NCMD":
            if any(given.name == REBIRTH and given.value for given in metrics):
                self.connected()
            return
        for given in metrics:
            self._command(levels[-1], given, sent_ms, is_retained=is_retained)

    def adopt(self, plant: Plant) -> None:
        """Use another plant, and send a death certificate (DDEATH) for each drive that it lacks."""
        self._plant = plant
        for drive in self._sent.keys() - drives_of(plant).keys():
            self._replace_pending(drive, "DDEATH", self._device_death)
        self._sent.clear()  # send all birth certificates again, because drives may have other registers
        self._changed.clear()

    def publish(self) -> None:
        """Send changed values, and the birth and death certificates of drives."""
        for drive in self._hub.drives:
            if self._hub.state(drive) == SILENT:
                if self._sent.pop(drive, None) is not None:
                    self._replace_pending(drive, "DDEATH", self._device_death)
                continue
            values = self._values(drive)
            before = self._sent.get(drive)
            self._sent[drive] = values
            if before is None:
                self._replace_pending(drive, "DBIRTH", self._device_birth)
                continue
            changed = {name: value for name, value in values.items() if value != before[name]}
            if changed:
                times = self._times(drive)
                self._changed.setdefault(drive, {}).update(
                    {name: (value, times[name]) for name, value in changed.items()}
                )
                self._put(drive, "DDATA", self._data)

    def leave(self) -> None:
        """Publish that the node is offline (its death certificate).

        After a regular disconnect, the broker does not publish the connection's last will.
        """
        self.outbox.put(Publication(self._topic("NDEATH"), self._death, qos=1))

    # ---- historical values ----

    def find(self, drive: str, register: str) -> tuple[Drive | None, Register[Any] | None]:
        """Return the drive with this name, and its register or channel with this name.

        Either is None if the node publishes no metric for it.
        """
        known = drives_of(self._plant).get(drive) if drive in {*self._hub.drives} else None
        metrics = {one.name: one for one, *_ in self._hub.known(drive)} if known else {}
        return known, metrics.get(register)

    async def send_past(self, values: Sequence[PastValue], confirm: Callable[[], Awaitable[None]]) -> None:
        """Send values as historical values, and wait until the broker has received them.

        `confirm` waits for the broker. Raises OSError if `confirm` does, or if values are not sent. Values of
        drives and registers that the node does not publish are left out. If a drive is silent, its birth
        certificate is sent first, because Sparkplug requires one before any value. The next call of `publish`
        sends the drive's death certificate again.
        """
        metrics = {drive: self._values(drive).keys() for drive in self._hub.drives}
        for begin in range(0, len(values), MOST_PAST):
            self._past = {}
            for one in values[begin : begin + MOST_PAST]:
                if _metric_of(one.register) in metrics.get(one.drive, ()):
                    self._past.setdefault(one.drive, []).append(one)
            try:
                for drive in [*self._past]:
                    if drive not in self._sent:
                        self._sent[drive] = self._values(drive)
                        self._replace_pending(drive, "DBIRTH", self._device_birth)
                    self._put(drive, "DDATA", self._data)
                await confirm()
                if self._past:
                    raise ConnectionError(
                        "a birth or death certificate was sent while stored values were being sent"
                    )
            finally:
                self._past = {}

    # ---- payloads; each has a sequence number, so it is made when it is sent ----

    def _replace_pending(self, drive: str, kind: str, make: Any) -> None:
        """Send a drive's birth or death certificate, and drop the drive's other waiting messages."""
        for other in {"DBIRTH", "DDATA", "DDEATH"} - {kind}:
            self.outbox.withdraw(self._topic(other, drive))
        self._put(drive, kind, make)

    def _put(self, drive: str, kind: str, make: Any) -> None:
        self.outbox.put(Publication(self._topic(kind, drive), lambda: make(drive), qos=0))

    def _next(self) -> int:
        self._seq = (self._seq + 1) % SEQUENCES
        return self._seq

    def _death(self) -> bytes:
        now = self._utc_ms()
        return payload(now, [Metric(DataType.INT64, self._birth, now, BIRTH_DEATH)], None)

    def _node_birth(self) -> bytes:
        self._seq, now = 0, self._utc_ms()
        metrics = [
            Metric(DataType.INT64, self._birth, now, BIRTH_DEATH),
            Metric(DataType.BOOLEAN, False, now, REBIRTH),
        ]
        return payload(now, metrics, self._seq)

    def _device_birth(self, drive: str) -> bytes:
        now, values, times = self._utc_ms(), self._values(drive), self._times(drive)
        self._sent[drive] = values
        self._changed.pop(drive, None)
        metrics = []
        for name, value in values.items():
            register = self._register(drive, name)
            unit = register.value_unit if register and register.values is None else ""
            alias = self._alias(drive, name)
            metrics.append(Metric(_datatype(register), value, times[name], name, alias, unit))
        if self._settings.commands:
            metrics.append(Metric(DataType.BOOLEAN, False, now, STOP, self._alias(drive, STOP)))
        return payload(now, metrics, self._next())

    def _device_death(self, drive: str) -> bytes:
        return payload(self._utc_ms(), [], self._next())

    def _data(self, drive: str) -> bytes:
        metrics = [
            Metric(_datatype(self._register(drive, name)), value, time, alias=self._alias(drive, name))
            for name, (value, time) in self._changed.pop(drive, {}).items()
        ]
        for past in self._past.pop(drive, []):
            name = _metric_of(past.register)
            kind, alias = _datatype(self._register(drive, name)), self._alias(drive, name)
            metrics.append(Metric(kind, past.value, past.time_ms, alias=alias, is_historical=True))
        return payload(self._utc_ms(), metrics, self._next())

    def _values(self, drive: str) -> dict[str, Value]:
        shown = self._hub.seen(drive)
        found: dict[str, Value] = {STATE: shown.state, FAULT: shown.fault}
        found |= {_metric_of(name): value for name, value in published_values(self._hub, drive).items()}
        for name in self._writable(drive):
            found.setdefault(_metric_of(name), None)
        return found

    def _times(self, drive: str) -> dict[str, int]:
        """Return a time for each metric (UTC, ms): when its value was polled, or now if it has no value."""
        now = self._utc_ms()
        times = dict.fromkeys(self._values(drive), now)
        for register, newest, good, is_current in self._hub.known(drive):
            if is_current and good is not None and newest is good:
                times[_metric_of(register.name)] = good[0] // 1_000_000
        return times

    def _writable(self, drive: str) -> list[str]:
        if not self._settings.commands:
            return []
        listed = self._context.commands.may.write
        return [name for name in self._registers(drive) if f"{drive}.{name}" in listed]

    def _registers(self, drive: str) -> dict[str, Register[Any]]:
        known = drives_of(self._plant).get(drive)
        return {} if known is None else dict(known.registers)

    def _register(self, drive: str, name: str) -> Register[Any] | None:
        """Return the register or channel of a metric; None for the metrics "state" and "fault"."""
        known = self._registers(drive) | {one.name: one for one, *_ in self._hub.known(drive)}
        return None if name in OWN else known[name.removeprefix(REGISTERS)]

    def _alias(self, drive: str, name: str) -> int:
        return self._aliases.setdefault((drive, name), len(self._aliases) + 1)

    # ---- commands ----

    def _command(self, drive: str, given: ReceivedMetric, sent_ms: int, *, is_retained: bool) -> None:
        name = given.name or self._name_of(drive, given.alias)
        register = name.removeprefix(REGISTERS)
        is_writable = name not in OWN and register in self._writable(drive)
        if name == STOP and given.value:
            self._commands.stop([drive])
        elif is_retained:
            self._commands.refuse(drive, name, "it was retained; publish it without retain")
        elif not is_writable or not isinstance(given.value, (int, float)):
            self._commands.refuse(drive, name, "it must be a register listed in [serve.may], with a number")
        else:
            self._commands.write(drive, register, float(given.value), sent_ms)

    def _name_of(self, drive: str, alias: int | None) -> str:
        known = {number: name for (owner, name), number in self._aliases.items() if owner == drive}
        return known.get(alias or 0, f"alias {alias}")

    def _report(self, drive: str, what: str, result: CommandResult, command: str) -> None:
        log = _log.info if result.ok else _log.warning
        log("%s of %s (command %s): %s", what, drive, command, result.text)


def _datatype(register: Register[Any] | None) -> DataType:
    return DataType.DOUBLE if register and register.values is None else DataType.STRING


def _metric_of(register: str) -> str:
    return f"{REGISTERS}{register}" if register in OWN else register
