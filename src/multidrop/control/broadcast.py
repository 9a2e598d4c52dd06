"""Broadcaster: write to all drives of a bus with one broadcast, if that is harmless to each drive.

A register address means different things to different families: one family's stop may be another's start.
So all drives must be of one family, and must have the same settings and framing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from multidrop.control.audit_log import check_author
from multidrop.control.call import Call
from multidrop.control.latches import Latches
from multidrop.control.performer import Performer
from multidrop.control.rules import check_broadcast, is_harmless, is_stop, raw_count
from multidrop.control.writer import Writer
from multidrop.core import Framing
from multidrop.drive.family import Drive
from multidrop.drive.register import Register
from multidrop.drive.state import State
from multidrop.errors import BusError, Unconfirmed, WriteForbidden


class Broadcaster:
    """Sends broadcasts to all drives of one bus."""

    def __init__(self, writer: Writer, performer: Performer, latches: Latches) -> None:
        self._writer = writer
        self._performer = performer
        self._latches = latches

    def write(
        self, drives: Sequence[Drive], register: Register[Any] | str, value: Any
    ) -> dict[str, State | BusError]:
        """Broadcast a write; return by drive name the state read afterwards, or the error of that read.

        Raises WriteForbidden if the write must not be broadcast.
        """
        if isinstance(register, str):
            if not drives:
                raise ValueError("no drive is attached to this bus")
            register = drives[0].register(register)
        if drives and drives[0].framing is Framing.TCP:
            raise WriteForbidden(
                f"{register.name} cannot be broadcast over Modbus TCP: there, unit id 0 is not a broadcast, "
                f"but the gateway or the device itself; write to one drive after another",
                register=register.name,
                rule="Modbus TCP has no broadcast",
            )
        if not _are_alike(drives):
            raise WriteForbidden(
                f"{register.name} cannot be broadcast: the drives on this line differ in family or "
                f"settings, so an address may be another register on each; write to one drive after another",
                register=register.name,
                rule="the drives on the line differ",
            )
        first = drives[0]
        raw = raw_count(first, register, value)
        if raw not in register.broadcast:
            raise WriteForbidden(f"{first.title} has no harmless broadcast of {register.name} = {value}")
        for drive in drives:
            check_broadcast(drive, register, raw)
        if is_harmless(register, raw):
            for drive in drives:
                self._performer.check_identity(drive)
            self._latches.rise(drives)
            call = None
        else:
            call = self._checked_call(drives, f"{register.name} = {register.format(register.decode(raw))}")
        if register.name == first.setpoint_name:
            for drive in drives:
                drive.commanded = None
        try:
            self._writer.broadcast(first, register, raw, call)
        finally:
            self._writer.records.catch_up()
        return {drive.name: self._state(drive) for drive in drives}

    def _checked_call(self, drives: Sequence[Drive], what: str) -> Call:
        """Check that each drive may be written; return a new call of the first drive, for the broadcast."""
        check_author()
        calls = [self._performer.call(drive) for drive in drives]
        for call in calls:
            self._writer.identity_check.check(call.drive, call.look)
        for call in calls:
            call.check(what)
        return calls[0].restarted()

    def _state(self, drive: Drive) -> State | BusError:
        try:
            return cast(State, self._performer.perform(drive.state.script(), self._performer.call(drive)))
        except BusError as failure:
            return failure

    def stop(self, drives: Sequence[Drive]) -> bool:
        """Broadcast a stop if `identify` has confirmed each drive and their family has a broadcast stop.

        Return True if the stop may have been sent.
        """
        known = all(self._writer.identity_check.is_known(drive) for drive in drives)
        control = drives[0].registers.get("control") if drives else None
        if len(drives) < 2 or not _are_alike(drives) or not known or drives[0].framing is Framing.TCP:
            return False
        if control is None or not control.broadcast or not is_stop(drives[0], control, control.broadcast[0]):
            return False
        try:
            self._writer.broadcast(drives[0], control, control.broadcast[0])
        except Exception as failure:  # not raised: the caller also sends each drive its own stop
            return isinstance(failure, Unconfirmed)
        return True


def _are_alike(drives: Sequence[Drive]) -> bool:
    return len({(type(drive), drive.settings, drive.framing) for drive in drives}) == 1
