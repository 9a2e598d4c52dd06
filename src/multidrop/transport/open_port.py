"""OpenPort: a port as the system has it, and what the core reads from and writes to."""

from __future__ import annotations

import os
from contextlib import suppress

import serial

from multidrop.core import (
    RS485,
    Mastership,
    Port,
    TransactionIds,
    Transactions,
    is_pseudo_terminal,
    must_take,
)
from multidrop.drive.line_settings import speaks_tcp
from multidrop.errors import LineError
from multidrop.transport import clock
from multidrop.transport.bridge import PORT_FAILURES, Bridge, hand_on_nothing_late, set_up
from multidrop.transport.opening import (
    connection_of,
    descriptor_of,
    device_of,
    identity_of,
    is_bridged,
    reason_of,
    unopened,
)
from multidrop.transport.overruns import overruns
from multidrop.transport.usb_adapter import USBAdapter, adapter_of

BY_PLACE = "/dev/serial/by-path/"  # names that mean whatever is plugged in there
_NO_SETTINGS = -1
_TRANSACTIONS = {
    TransactionIds.MATCH: Transactions.MATCHED,
    TransactionIds.IGNORE: Transactions.IGNORED,
}


def _refusal(rs485: RS485, failure: OSError) -> str:
    """Return why a port cannot be polled: its driver refuses to switch the transceiver."""
    what = "has no RS-485 mode" if rs485 is RS485.KERNEL else "does not switch RTS"
    return f'the driver {what} ({os.strerror(failure.errno or 0)}), which rs485 = "{rs485}" needs'


class OpenPort:
    """A port of pyserial's, and a bridge where the core cannot read from and write to that itself.

    It may be opened and closed again and again, by one thread at a time.
    """

    def __init__(
        self,
        name: str,
        ids: TransactionIds,
        rs485: RS485,
        mastership: Mastership | None,
        settle: float = 0.0,
    ) -> None:
        self.name = name
        self.identity = name  # see port_identity; known once it was open
        self.bridge: Bridge | None = None
        self.settings: tuple[int, str] | None = None  # that a bridged port must have
        self._ids = ids
        self._rs485 = rs485
        self._mastership = mastership
        self._settle = settle
        self._serial: serial.SerialBase | None = None
        self._adapter: USBAdapter | None = None  # with which it was open first

    def open(self) -> Port:
        """Open it for the core, and return it when it has settled: what came until then is discarded.

        Raises LineError, or one of PORT_FAILURES; then close it.
        """
        port = self._serial = unopened(self.name)
        port.timeout = 0
        if isinstance(port, serial.Serial):
            port.exclusive = True
            port.rts = self._rs485 is not RS485.RTS_UP  # else the transceiver sends once it is open
        port.open()
        if isinstance(port, serial.Serial) and not self.name.startswith(BY_PLACE):
            self._require_same_adapter(device_of(port))
        self.identity = identity_of(port, self.name)
        if self._settle:
            clock.sleep(self._settle)
            port.reset_input_buffer()
        core = self._drive(port)
        with suppress(*PORT_FAILURES, AttributeError, NotImplementedError):
            port.set_low_latency_mode(True)  # a USB adapter else holds bytes back for 16 ms
        return core

    def _require_same_adapter(self, device: str) -> None:
        """Raise LineError where another adapter came back under this name: on its line are other motors."""
        found = adapter_of(device)
        if self._adapter is None:
            self._adapter = found
        elif found is None or not found.is_same(self._adapter):
            raise LineError(
                self.name,
                f"another adapter has this name now ({found or 'none on USB'}, and not {self._adapter}); "
                "if it is meant, begin anew; a name in /dev/serial/by-id stays with its adapter",
            )

    def _drive(self, port: serial.SerialBase) -> Port:
        """Give the core a descriptor of this port."""
        if type(port).read is serial.Serial.read:
            device = device_of(port)
            opened = Port(descriptor_of(port), must_take(device), mastership=self._mastership)
            return self._switched(opened, device)
        if connection := connection_of(port):
            hand_on_nothing_late(connection)
        if connection and not is_bridged(port):
            connection.setblocking(False)
            ids = _TRANSACTIONS[self._ids] if speaks_tcp(self.name) else Transactions.NONE
            return Port(connection.fileno(), _NO_SETTINGS, transactions=ids, mastership=self._mastership)
        if self.settings:
            set_up(port, self.settings)
        self.bridge = Bridge(port)
        return Port(self.bridge.theirs.fileno(), _NO_SETTINGS)

    def _switched(self, core: Port, device: str) -> Port:
        """Have its transceiver switched; a pseudo-terminal has none, and goes without."""
        try:
            core.switch(self._rs485)
        except OSError as failure:
            if not is_pseudo_terminal(device):
                core.close()
                raise LineError(self.name, _refusal(self._rs485, failure)) from failure
        return core

    def close(self) -> None:
        """Close it, however much of it is open."""
        if self.bridge:
            self.bridge.close()
            self.bridge = None
        if self._serial:
            connection = connection_of(self._serial)
            with suppress(*PORT_FAILURES):
                self._serial.close()
            if connection:  # pyserial leaves one open that has ended already
                connection.close()

    def forget(self) -> None:
        """Close the child's descriptors after a fork: the parent still uses the port."""
        if self.bridge:
            self.bridge.forget()
            self.bridge = None
        # Of a network port the socket alone: pyserial would end the connection, which the parent has too.
        port = connection_of(self._serial) or self._serial
        if port:
            with suppress(*PORT_FAILURES):
                port.close()

    def require(self, settings: tuple[int, str]) -> None:
        """Give a bridged port these settings: it can have only one kind of them.

        Raises LineError when it has others already, or does not take these.
        """
        if self._serial is None or self.bridge is None:  # it may be one, when it is there
            self.settings = self.settings or settings
            return
        if self.settings == settings:
            return
        if self.settings:
            raise LineError(self.name, "this kind of port cannot change its settings from drive to drive")
        try:
            set_up(self._serial, settings)
        except PORT_FAILURES as failure:
            raise LineError(self.name, reason_of(failure)) from failure
        self.settings = settings

    def overruns(self) -> int | None:
        """Return how many characters came too fast for the port, since its driver was loaded.

        None while it is closed, and where the driver does not count them.
        """
        try:
            return None if self.bridge or not self._serial else overruns(self._serial.fileno())
        except (*PORT_FAILURES, TypeError, AttributeError):  # it may be closed meanwhile
            return None
