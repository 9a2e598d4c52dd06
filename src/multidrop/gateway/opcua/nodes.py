"""The address space of the OPC UA server: the nodes of a plant's drives and values."""

from __future__ import annotations

import asyncio
import gc
import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import cache, lru_cache
from typing import Any, NamedTuple

from asyncua import ua
from asyncua.server.address_space import AttributeValue
from asyncua.server.internal_server import InternalServer

from multidrop import Plant, PolledDrive, Register
from multidrop.gateway.live import hub
from multidrop.gateway.opcua import FAULT, RESULTS, STATE, STOP, UNIT

INDEX = 2  # index of the namespace of all nodes of this module
PLANT, PLANT_STOP = ua.NodeId(1, INDEX), ua.NodeId(2, INDEX)
SOME = 64  # number of values that are written before clients' requests are served again
# limit of removed drives whose memory (10 kB each) is not freed yet; above it, the memory is freed
MOST_REMOVED = 500
UNITS_OF = "http://www.opcfoundation.org/UA/units/un/cefact"
# Code of a unit in UNECE Recommendation 20, by unit. The unit's id in OPC UA is made of the code's bytes (OPC
# 10000-8, 5.6.3).
UNITS = {
    "Hz": "HTZ",
    "kHz": "KHZ",
    "V": "VLT",
    "A": "AMP",
    "mA": "4K",
    "W": "WTT",
    "kW": "KWT",
    "kWh": "KWH",
    "%": "P1",
    "rpm": "RPM",
    "°C": "CEL",
    "ms": "C26",
    "s": "SEC",
    "min": "MIN",
    "h": "HUR",
    "Nm": "NU",
    "bar": "BAR",
    "atm": "ATM",
    "kPa": "KPA",
    "MPa": "MPA",
    "kgf/cm²": "E42",
}
_Codes = ua.StatusCodes
GOOD, WAITING = _Codes.Good, _Codes.BadWaitingForInitialData
STALE, HELD = _Codes.UncertainLastUsableValue, _Codes.UncertainNoCommunicationLastUsableValue
SILENT = _Codes.BadNoCommunication
REMOVED = _Codes.BadNodeIdUnknown
DAMAGED = (
    *("reply cut short", "bad checksum", "bad character", "no frame in what was received"),
    *("reply from another address", "reply to another function", "reply of another length"),
    "maybe the adapter's echo",
)
# OPC UA's status code by the status of a failed read. All other statuses mean that the drive cannot be
# reached.
CODES = {"no valid value": _Codes.BadSensorFailure} | dict.fromkeys(DAMAGED, _Codes.BadCommunicationError)
REFUSED = "exception "
NOTHING = ua.Variant(None, ua.VariantType.Null)

_log = logging.getLogger("multidrop.gateway")


@contextmanager
def lasting() -> Iterator[None]:
    """Exclude all existing Python objects from garbage collection at the end of the `with` block.

    The block makes the nodes of the OPC UA server: 400,000 objects that live as long as the server. With
    them, each garbage collection would stop all threads for 0.2 s. An excluded object is still freed when its
    last reference ends. But objects in a reference cycle, such as the drives of an old plant, are freed only
    by `free_excluded`.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if was_enabled:
            gc.enable()


def free_excluded() -> None:
    """Collect garbage among all objects, also those that `lasting` excluded. This stops threads for 0.2 s."""
    gc.unfreeze()
    gc.collect()


class VariableState(NamedTuple):
    """The value, status code and time of one variable. If the status code is bad, the value is None."""

    drive: str
    name: str  # the register's name, or STATE or FAULT
    code: int  # OPC UA's status code
    value: float | str | None
    time_ns: int  # when the value was requested, UTC in ns


def state_of(
    drive: str, name: str, newest: hub.KeptRow | None, good: hub.KeptRow | None, is_current: bool, reason: str
) -> VariableState:
    """Return the state of a register's variable from the register's newest rows (reads).

    `newest` is the newest row, and `good` the newest row with a value. If they differ, the newest read has
    failed. If `is_current`, the variable keeps the value of `good` even if later reads have failed. `reason`
    is the status of `newest`.
    """
    if newest is None:
        return VariableState(drive, name, WAITING, None, 0)
    if good is not None and (newest is good or is_current):
        code = (GOOD if is_current else STALE) if newest is good else HELD
        return VariableState(drive, name, code, good[2], good[0])
    code = _Codes.BadDeviceFailure if reason.startswith(REFUSED) else CODES.get(reason, SILENT)
    return VariableState(drive, name, code, None, newest[0])


def fault_of(shown: hub.Shown) -> tuple[int, str | None]:
    """Return the status code and the text of a drive's fault.

    The text is "" without a fault, and None if the fault is unknown.
    """
    if shown.words is None or shown.state == hub.FAULT:
        return GOOD, shown.words or ""
    return SILENT if shown.state == hub.SILENT else _Codes.Bad, None


class _Variant(ua.Variant):
    """A number or a text with its OPC UA type. asyncua's check of the type is skipped."""

    __slots__ = ()

    def __post_init__(self) -> None: ...


class _Value(ua.DataValue):
    """A value that never changes, so asyncua need not copy it.

    A copy would take 50 us for each subscriber.
    """

    __slots__ = ()

    def __post_init__(self) -> None: ...

    def __deepcopy__(self, memo: object) -> _Value:
        return self


class _Variable:
    """A variable of the OPC UA server, and its newest state.

    The value that clients get is made on request, because few variables have subscribers.
    """

    def __init__(self, state: VariableState, register: Register[Any] | None) -> None:
        self.state = state
        self._register = register

    def value(self, *node: object) -> _Value:
        _, _, code, value, time_ns = self.state
        if isinstance(value, float) and self._register is not None:
            value = hub.published_value(self._register, value)
        kind = ua.VariantType.Double if isinstance(value, float) else ua.VariantType.String
        variant = NOTHING if value is None else _Variant(value, kind, None, False)
        return _Value(variant, _status(code), _time(time_ns))


@lru_cache(maxsize=64)  # cached, because the registers of one request share its time
def _time(ns: int) -> datetime | None:
    return datetime.fromtimestamp(ns / 1e9, UTC) if ns else None


class _Drive(NamedTuple):
    polled: PolledDrive
    nodes: list[ua.NodeId]  # all nodes of the drive
    variables: dict[str, tuple[_Variable, AttributeValue]]


class PlantNodes:
    """The object of the plant, and in it an object for each drive, with a variable for each polled register.

    All methods must be called in the event loop of the OPC UA server.
    """

    def __init__(self, server: InternalServer) -> None:
        # drive that a stop method stops, by the id of the method's node; None: all drives
        self.stops: dict[ua.NodeId, str | None] = {PLANT_STOP: None}
        self._session = server.isession
        self._space = server.aspace
        self._drives: dict[str, _Drive] = {}
        self._removed = 0  # number of drives removed since the last call of `free_excluded`

    async def make(self) -> None:
        """Add the plant's object, without drives."""
        await self._add(
            _object(ua.NodeId(ua.ObjectIds.ObjectsFolder), PLANT, "Plant", "all drives"),
            *_method(PLANT, PLANT_STOP, ua.NodeId(3, INDEX), "Stop all drives of the plant."),
        )

    async def _add(self, *items: ua.AddNodesItem) -> list[ua.NodeId]:
        for result in await self._session.add_nodes([*items]):
            result.StatusCode.check()
        return [item.RequestedNewNodeId for item in items]

    async def adopt(self, plant: Plant) -> None:
        """Remove the nodes of drives that the new plant lacks or changes, and add the nodes of new drives."""
        wanted = {polled.drive.name: polled for polled in plant.drives}
        for name in [name for name, known in self._drives.items() if wanted.get(name) != known.polled]:
            await self._remove(name)
            self._removed += 1
        if self._removed > MOST_REMOVED:
            self._removed = 0
            free_excluded()
        with lasting():
            for name, polled in wanted.items():
                if name not in self._drives:
                    await self._add_drive(name, polled)
                    await asyncio.sleep(0)

    async def _add_drive(self, name: str, polled: PolledDrive) -> None:
        drive, stop = polled.drive, _node_id(name, STOP)
        registers = {poll.register.name: poll.register for poll in polled.series}
        variables = {member: _node_id(name, member) for member in (*registers, STATE, FAULT)}
        items = [
            _object(PLANT, _node_id(name), name, drive.title),
            *_method(_node_id(name), stop, _node_id(name, STOP, RESULTS), "Stop this drive."),
            _variable(_node_id(name), variables[STATE], STATE, "runs, stands, fault, silent or unknown", str),
            _variable(_node_id(name), variables[FAULT], FAULT, "what the drive shows as its fault", str),
        ]
        for member, register in registers.items():
            kind, unit = str if register.values is not None else float, register.value_unit
            type_of = "AnalogUnitType" if unit and kind is float else "BaseDataVariableType"
            text = register.note or member
            items.append(_variable(_node_id(name), variables[member], member, text, kind, type_of))
            if unit and kind is float:
                items.append(_unit(variables[member], _node_id(name, member, UNIT), unit))
        nodes = await self._add(*items)
        found = {}
        for member, node in variables.items():
            variable = _Variable(VariableState(name, member, WAITING, None, 0), registers.get(member))
            self._space.set_attribute_value_callback(node, ua.AttributeIds.Value, variable.value)
            found[member] = variable, self._space[node].attributes[ua.AttributeIds.Value]
        self.stops[stop] = name
        self._drives[name] = _Drive(polled, nodes, found)

    async def _remove(self, name: str) -> None:
        """Remove a drive's nodes.

        Subscribers of the drive's values get a bad status as their last notification.
        """
        drive, space = self._drives.pop(name), self._space
        del self.stops[_node_id(name, STOP)]
        for member, (variable, attribute) in drive.variables.items():
            variable.state = VariableState(name, member, REMOVED, None, 0)
            await _notify(variable, attribute)
            for handle in [*attribute.datachange_callbacks]:
                space.delete_datachange_callback(handle)
        of_plant = space[PLANT].references
        of_plant[:] = [one for one in of_plant if one.NodeId != _node_id(name)]
        for node in drive.nodes:
            del space[node]

    async def write(self, states: Iterable[VariableState]) -> None:
        """Store these states, and notify their subscribers.

        Each time SOME (64) states are written, other tasks of the event loop run, such as a client's stop.
        """
        for count, state in enumerate(states, 1):
            drive = self._drives.get(state.drive)
            if drive is not None and state.name in drive.variables:
                variable, attribute = drive.variables[state.name]
                variable.state = state
                await _notify(variable, attribute)
            if count % SOME == 0:
                await asyncio.sleep(0)


async def _notify(variable: _Variable, attribute: AttributeValue) -> None:
    if not attribute.datachange_callbacks:
        return
    value = variable.value()
    for handle, callback in [*attribute.datachange_callbacks.items()]:
        try:
            await callback(handle, value)
        except Exception:  # for example, a client has demanded a deadband for a text
            drive, name, *_ = variable.state
            _log.debug("a subscriber of %s.%s failed", drive, name, exc_info=True)


def object_of(drive: str | None) -> ua.NodeId:
    """Return the id of a drive's object; of the plant's object if `drive` is None."""
    return PLANT if drive is None else _node_id(drive)


def _node_id(*names: str) -> ua.NodeId:
    return ua.NodeId(".".join(names), INDEX)


@cache
def _status(code: int) -> ua.StatusCode:
    return ua.StatusCode(code)


def _item(parent: ua.NodeId, node: ua.NodeId, name: str, attributes: Any, reference: str) -> ua.AddNodesItem:
    """Return the request to add a node with this display name.

    `attributes` has the node's other attributes.
    """
    attributes.DisplayName = ua.LocalizedText(name)
    attributes.WriteMask = attributes.UserWriteMask = 0
    item = ua.AddNodesItem()
    item.ParentNodeId, item.RequestedNewNodeId = parent, node
    item.ReferenceTypeId = ua.NodeId(getattr(ua.ObjectIds, reference))
    item.NodeAttributes = attributes
    return item


def _object(parent: ua.NodeId, node: ua.NodeId, name: str, description: str) -> ua.AddNodesItem:
    attributes = ua.ObjectAttributes()
    attributes.Description, attributes.EventNotifier = ua.LocalizedText(description), 0
    item = _item(parent, node, name, attributes, "Organizes" if node == PLANT else "HasComponent")
    item.NodeClass, item.BrowseName = ua.NodeClass.Object, ua.QualifiedName(name, INDEX)
    item.TypeDefinition = ua.NodeId(ua.ObjectIds.BaseObjectType)
    return item


def _variable(
    parent: ua.NodeId,
    node: ua.NodeId,
    name: str,
    description: str,
    kind: type,
    type_of: str = "BaseDataVariableType",
) -> ua.AddNodesItem:
    """Return the request to add a variable for numbers or texts that clients may only read."""
    value = ua.Variant(0.0, ua.VariantType.Double) if kind is float else ua.Variant("", ua.VariantType.String)
    item = _item(parent, node, name, _values(value, value.VariantType.value, description), "HasComponent")
    item.NodeClass, item.BrowseName = ua.NodeClass.Variable, ua.QualifiedName(name, INDEX)
    item.TypeDefinition = ua.NodeId(getattr(ua.ObjectIds, type_of))
    return item


def _property(parent: ua.NodeId, node: ua.NodeId, name: str, value: Any, data_type: int) -> ua.AddNodesItem:
    item = _item(parent, node, name, _values(value, data_type, name), "HasProperty")
    item.NodeClass, item.BrowseName = ua.NodeClass.Variable, ua.QualifiedName(name, 0)
    item.TypeDefinition = ua.NodeId(ua.ObjectIds.PropertyType)
    return item


def _values(value: ua.Variant, data_type: int, description: str) -> ua.VariableAttributes:
    attributes = ua.VariableAttributes()
    attributes.Value, attributes.DataType = value, ua.NodeId(data_type)
    attributes.Description = ua.LocalizedText(description)
    attributes.ValueRank = ua.ValueRank.OneDimension if value.is_array else ua.ValueRank.Scalar
    attributes.ArrayDimensions = [0] if value.is_array else None
    attributes.Historizing = False
    attributes.AccessLevel = attributes.UserAccessLevel = ua.AccessLevel.CurrentRead.mask
    return attributes


def unit_of(unit: str) -> ua.EUInformation:
    """Return OPC UA's description of a unit. The description's id is -1 if UNECE has no code for the unit."""
    code = UNITS.get(unit, "")
    number = int.from_bytes(code.encode(), "big") if code else -1
    return ua.EUInformation(UNITS_OF, number, ua.LocalizedText(unit), ua.LocalizedText(unit))


def _unit(parent: ua.NodeId, node: ua.NodeId, unit: str) -> ua.AddNodesItem:
    value = ua.Variant(unit_of(unit), ua.VariantType.ExtensionObject)
    return _property(parent, node, UNIT, value, ua.ObjectIds.EUInformation)


def _method(
    parent: ua.NodeId, node: ua.NodeId, results: ua.NodeId, description: str
) -> Iterator[ua.AddNodesItem]:
    """Yield two requests: to add a method, and to add the description of the text that it returns."""
    attributes = ua.MethodAttributes()
    attributes.Description = ua.LocalizedText(description)
    attributes.Executable = attributes.UserExecutable = True
    item = _item(parent, node, STOP, attributes, "HasComponent")
    item.NodeClass, item.BrowseName = ua.NodeClass.Method, ua.QualifiedName(STOP, INDEX)
    yield item
    text = ua.Argument(
        "Text", ua.NodeId(ua.ObjectIds.String), ua.ValueRank.Scalar, [], ua.LocalizedText("the outcome")
    )
    arguments = ua.Variant([text], ua.VariantType.ExtensionObject)
    yield _property(node, results, RESULTS, arguments, ua.ObjectIds.Argument)
