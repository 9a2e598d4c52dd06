"""ModbusConnection: multidrop as a backend of the package `modbus-connection`, which device libraries use.

Requests run on threads of the event loop's executor, by the rules of `Bus` and `ModbusDevice`.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from multidrop.bus import Bus
from multidrop.core import Framing
from multidrop.drive import SERVER_ID, STATUS
from multidrop.drive.line_settings import check_port
from multidrop.errors import (
    BadReply,
    BusError,
    DriveException,
    Expired,
    LineError,
    NoReply,
    NotVerified,
    Unconfirmed,
)
from multidrop.modbus_device import ModbusDevice
from multidrop.printable import install_command
from multidrop.transport.exchange import READ_ATTEMPTS

try:
    import modbus_connection as neutral
except ImportError as missing:
    raise ImportError(
        "multidrop.modbus_connection needs Python 3.12 or newer and the package modbus-connection: "
        f"{install_command('modbus-connection')}"
    ) from missing

# limit, in s, of the first timeout on a port without transaction ids; a late reply lengthens it
MOST_WAIT = 1.0
LOSS_CHECK = 1.0  # seconds between checks whether an idle connection is lost
OTHER = "use the ModbusConnection of modbus_connection.pymodbus"
COUNTERS = (2, *range(0x0B, 0x13))  # sub-functions of function 08 that only read; 4 would silence a device
# The command-line helper of `modbus-connection` reads this name.
SUPPORTED_FRAMINGS = {"tcp": ("socket", "rtu", "ascii"), "serial": ("rtu", "ascii")}

_log = logging.getLogger("multidrop.modbus_connection")

T = TypeVar("T")
Method = TypeVar("Method", bound=Callable[..., Awaitable[Any]])


def _port_of(params: Any) -> str:
    """Return the name of the port. Raises ValueError for UDP, TLS, and a port that is not supported."""
    if isinstance(params, neutral.ModbusSerialParams):
        return check_port(params.device)
    if isinstance(params, neutral.ModbusTcpParams):
        host = f"[{params.host}]" if ":" in params.host else params.host
        return check_port(f"{'tcp' if params.framer == 'socket' else 'socket'}://{host}:{params.port}")
    raise ValueError(f"multidrop does not support {type(params).__name__}: {OTHER}")


def _family_of(params: Any, timeout: float) -> type[ModbusDevice]:
    """Return a device class with the line settings in `params` and a response time-out from `timeout`."""
    baudrate, format, wait = 9600, "8N1", timeout / READ_ATTEMPTS
    if isinstance(params, neutral.ModbusSerialParams):
        baudrate, format = params.baudrate, f"{params.bytesize}{params.parity}{params.stopbits}"
    # without transaction ids, the next request waits until no late reply can come
    if params.framer != "socket":
        wait = min(wait, MOST_WAIT)
    framing = Framing.ASCII if params.framer == "ascii" else Framing.RTU
    line = {"framings": (framing,), "formats": {framing: (format,)}, "baudrates": (baudrate,)}
    return type("ModbusDevice", (ModbusDevice,), {**line, "response_timeout": wait, "answering_time": wait})


class ModbusConnection(neutral.ModbusConnection):  # type: ignore[misc]
    """A connection of the package `modbus-connection`, whose requests are sent through a `Bus`.

    `params` and the times, in s, are those of the package's other backends. A read is sent up to three times
    within `timeout`, a write once. `options` are arguments of `Bus`, such as `audit` or `rs485`. Raises
    ValueError for UDP and TLS.
    """

    def __init__(
        self,
        params: Any,
        *,
        timeout: float | None = None,
        message_spacing: float | None = None,
        connect_delay: float | None = None,
        **options: Any,
    ) -> None:
        super().__init__(
            params, timeout=timeout, message_spacing=message_spacing, connect_delay=connect_delay
        )
        self._client: Bus | None
        self._port = _port_of(params)
        self._options = options
        self._former: Bus | None = None  # the bus of the previous connection
        self._watch: asyncio.Task[None] | None = None

    @property
    def connected(self) -> bool:
        """True while the connection is open and its port is not lost."""
        return self._client is not None and not self._client.line.is_lost

    def for_unit(self, unit_id: int) -> ModbusUnit:
        """Return the handle of a unit, whose address is checked at its first request."""
        return ModbusUnit(self, unit_id)

    async def connect(self) -> None:
        """Open the port unless it is open. Raises ModbusConnectionError if that fails."""
        self.notice_loss()
        await super().connect()

    def notice_loss(self) -> None:
        """If the port was lost, close it and call the callbacks for lost connections."""
        if self._client is not None and self._client.line.is_lost:
            self._on_connection_lost(None)

    def device(self, unit_id: int) -> ModbusDevice:
        """Return the device with this address. Raises ModbusConnectionError if the port is not open."""
        if self._client is None:
            raise neutral.ModbusConnectionError("connection is not established")
        for drive in self._client.drives:
            if drive.address == unit_id and isinstance(drive, ModbusDevice):
                return drive
        family = _family_of(self._params, self._client_timeout)
        return self._client.attach(family, unit_id, name=f"unit {unit_id}")

    async def _connect_client(self) -> Bus:
        if self._former is not None:  # the former bus may still be closing
            await asyncio.to_thread(self._former.close)
        options = {"expiry": self._client_timeout, **self._options}
        try:
            bus = await asyncio.to_thread(Bus, self._port, **options)
        except LineError as failure:
            raise neutral.ModbusConnectionError(f"could not connect: {failure}") from failure
        self._watch = asyncio.create_task(self._notice_losses(bus))
        return bus

    async def _close_client(self, client: Bus) -> None:
        self._former = client
        await asyncio.to_thread(client.close)

    def _on_connection_lost(self, error: Exception | None) -> None:
        if self._closed or self._client is None:
            return
        self._former, self._client = self._client, None
        asyncio.get_running_loop().run_in_executor(None, self._former.close)
        self._lost_callbacks.fire()

    async def _notice_losses(self, bus: Bus) -> None:
        while bus.is_open:
            await asyncio.sleep(LOSS_CHECK)
            if self._client is bus:
                self.notice_loss()


_KINDS: tuple[tuple[type[Exception], Any], ...] = (
    (LineError, neutral.ModbusConnectionError),
    (NoReply, neutral.ModbusTimeoutError),
    (Expired, neutral.ModbusTimeoutError),
    (BadReply, neutral.ModbusProtocolError),
)


def _neutral(failure: BusError, request: str) -> Exception:
    """Return the error of `modbus-connection` for a failed request."""
    sentence = f"{request}: {failure}"
    cause = failure.__cause__ if isinstance(failure, Unconfirmed) else failure
    code = cause.code if isinstance(cause, DriveException | NoReply) else 0
    if code:
        return neutral.ModbusExceptionError.from_code(code, sentence)  # type: ignore[no-any-return]
    kind = next((kind for ours, kind in _KINDS if isinstance(cause, ours)), neutral.ModbusError)
    return kind(sentence)  # type: ignore[no-any-return]


def _request(method: Method) -> Method:
    """Decorator: connect, wait for the unit's turn, and convert errors to those of `modbus-connection`."""

    @functools.wraps(method)
    async def request(unit: ModbusUnit, *arguments: Any, **named: Any) -> Any:
        connection = unit.connection
        await connection.connect()
        try:
            async with connection._pacer.paced(unit.unit_id):
                await connection.connect()  # the link may have been dropped during the wait
                return await method(unit, *arguments, **named)
        except BusError as failure:
            connection.notice_loss()
            shown = ", ".join([*map(repr, arguments), *(f"{name}={one!r}" for name, one in named.items())])
            raise _neutral(failure, f"{method.__name__}({shown})") from failure

    return request  # type: ignore[return-value]


def _unsupported(function: int) -> Callable[..., Awaitable[Any]]:
    async def refuse(unit: ModbusUnit, *arguments: Any, **named: Any) -> Any:
        raise NotImplementedError(f"multidrop does not send Modbus function {function:02X}H: {OTHER}")

    return refuse


class ModbusUnit:
    """One unit of a connection, with the methods of `modbus_connection.ModbusUnit`."""

    def __init__(self, connection: ModbusConnection, unit_id: int) -> None:
        self.connection = connection
        self.unit_id = unit_id

    @property
    def connected(self) -> bool:
        """True while the connection is open and its port is not lost."""
        return self.connection.connected

    def set_message_spacing(self, seconds: float) -> None:
        """Set the least time in s between the requests to this unit."""
        self.connection._pacer.set_unit_spacing(self.unit_id, seconds)

    def require_timeout(self, seconds: float | None) -> None:
        """Require a timeout of at least `seconds` for the connection; None withdraws the requirement."""
        self.connection._require_timeout(self.unit_id, seconds)

    def require_connect_delay(self, seconds: float | None) -> None:
        """Require a pause of at least `seconds` after each opening; None withdraws the requirement."""
        self.connection._require_connect_delay(self.unit_id, seconds)

    async def disconnect(self) -> None:
        """Close the port; the next request opens it again."""
        await self.connection.disconnect()

    def on_connection_lost(self, callback: Callable[[], None]) -> Callable[[], None]:
        """Call `callback` whenever the connection is lost; return a function that unregisters `callback`."""
        return self.connection.on_connection_lost(callback)  # type: ignore[no-any-return]

    async def _call(self, ask: Callable[..., T], *arguments: Any, **named: Any) -> T:
        return await asyncio.to_thread(ask, self.connection.device(self.unit_id), *arguments, **named)

    async def _write(self, ask: Callable[..., Any], *arguments: Any, **named: bool) -> None:
        """Carry out a write once. If the device then holds another value, log a warning instead of raising.

        NotVerified is not raised, because a command register may return to 0 by itself. A caller that repeats
        the write after an error would repeat the command.
        """
        try:
            await self._call(ask, *arguments, confirm=True, **named)
        except NotVerified as failure:
            _log.warning("%s", failure)

    @_request
    async def read_holding_registers(self, address: int, count: int) -> list[int]:
        return [*map(int, await self._call(ModbusDevice.read_holding, address, count))]

    @_request
    async def read_input_registers(self, address: int, count: int) -> list[int]:
        return [*map(int, await self._call(ModbusDevice.read_input, address, count))]

    @_request
    async def read_coils(self, address: int, count: int) -> list[bool]:
        return await self._call(ModbusDevice.read_coils, address, count)

    @_request
    async def read_discrete_inputs(self, address: int, count: int) -> list[bool]:
        return await self._call(ModbusDevice.read_discrete, address, count)

    @_request
    async def read_device_identification(self) -> dict[int, bytes]:
        return await self._call(ModbusDevice.read_identification)

    @_request
    async def write_register(self, address: int, value: int) -> None:
        await self._write(ModbusDevice.write_holding, address, [value])

    @_request
    async def write_registers(self, address: int, values: list[int]) -> None:
        await self._write(ModbusDevice.write_holding, address, values, multiple=True)

    @_request
    async def mask_write_register(self, address: int, and_mask: int, or_mask: int) -> None:
        await self._write(ModbusDevice.mask_holding, address, and_mask, or_mask)

    @_request
    async def write_coil(self, address: int, value: bool) -> None:
        await self._write(ModbusDevice.write_coils, address, [value])

    @_request
    async def write_coils(self, address: int, values: list[bool]) -> None:
        await self._write(ModbusDevice.write_coils, address, values, multiple=True)

    @_request
    async def diagnostics(self, sub_function: int, data: int = 0) -> int:
        if sub_function not in (0, *COUNTERS):
            raise NotImplementedError(
                f"multidrop does not send diagnostics sub-function {sub_function:02X}H: {OTHER}"
            )
        return int.from_bytes(await self._send(8, sub_function, data.to_bytes(2)))

    @_request
    async def read_exception_status(self) -> int:
        return (await self._call(ModbusDevice.read_raw, STATUS, 0, 0))[0]

    @_request
    async def get_comm_event_counter(self) -> tuple[bool, int]:
        reply = await self._send(0x0B)
        return reply[:2] == bytes(2), int.from_bytes(reply[2:])

    @_request
    async def get_comm_event_log(self) -> bytes:
        return (await self._send(0x0C))[6:]

    @_request
    async def report_server_id(self) -> bytes:
        return await self._call(ModbusDevice.read_raw, SERVER_ID, 0, 0)

    @_request
    async def read_fifo_queue(self, address: int) -> list[int]:
        data = (await self._send(0x18, address))[4:]
        return [int.from_bytes(data[at : at + 2]) for at in range(0, len(data), 2)]

    async def _send(self, function: int, start: int = 0, data: bytes = b"") -> bytes:
        return await self._call(ModbusDevice.send_raw, function, start, data)

    read_file_record = _unsupported(0x14)
    write_file_record = _unsupported(0x15)
    read_write_registers = _unsupported(0x17)
