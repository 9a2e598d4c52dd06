"""A drive of each family, the writes that start its motor, and a record of received requests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from unittest.mock import patch

from own_drives import Fan

from multidrop.core import Framing, Message, Status
from multidrop.drive import Drive
from multidrop.families import MODELS, YD1000, DelixiModbus, DelixiNative, ErmanERG220, InnovertIBD, InvtCHE
from multidrop.sim import EncodedDrive, MotorDrive, Wire
from multidrop.sim.receiver import Frame

MAKE: dict[str, Callable[[int], Drive]] = {
    "erman-er-g-220": ErmanERG220,
    "invt-che": lambda address: InvtCHE(address, maximum_frequency=50),
    "innovert-ibd": InnovertIBD,
    "delixi-modbus": lambda address: DelixiModbus(address, framing="rtu"),
    "delixi-native": DelixiNative,
    "yd1000": YD1000,
}
assert set(MAKE) == set(MODELS)

# Writes (address, value) that start the motor, by family, from the documents.
STARTS: dict[str, Callable[[Message], bool]] = {
    "erman-er-g-220": lambda each: each.function in (5, 15) and each.start == 0 and each.data != b"\0\0",
    "invt-che": lambda each: each.start == 0x1000 and each.data[-1] in (1, 2, 3, 4),
    "innovert-ibd": lambda each: each.start == 0x2000 and bool(each.data[-1] & 2),
    "delixi-modbus": lambda each: each.start == 0x2000 and bool(each.data[-1] & 2),
    "delixi-native": lambda each: each.function == 2 and each.start in (2, 3),
    "yd1000": lambda each: each.start == 0x1000 and (bool(each.data[0] & 0x05) or not each.data[0] & 0x80),
}
FAMILIES: dict[str, type[Drive]] = {**MODELS, "fan": Fan}
WRITES = (5, 6, 15, 16)
DELIXI_WRITES = (2, 4, 5, 6)


def quick(kind: str) -> type[Drive]:
    """Return the family with all line silences set to 0, because responders need none."""
    family = FAMILIES[kind]
    without = {"silence": 0.0, "silence_characters": 0.0, "response_delay_characters": 0.0}
    return type(family.__name__, (family,), without)


@contextmanager
def at_highest_rate(model: str) -> Iterator[None]:
    """Use the family's highest baud rate by default, because exchanges wait for the time of their bits."""
    rates = sorted(MODELS[model].baudrates, reverse=True)
    with patch.object(MODELS[model], "baudrates", tuple(rates)):
        yield


class ReceivedRequests:
    """Records the requests that a simulated drive receives; if `loses(request)`, the reply is lost."""

    def __init__(self, sim: MotorDrive) -> None:
        self.sim = sim
        self.requests: list[Message] = []
        self.loses: Callable[[Message], bool] = lambda request: False
        self._receive = sim.receive
        vars(sim)["receive"] = self.receive

    def receive(self, frame: Frame) -> Message | None:
        request = frame.message
        if request is None or not frame.intact:
            return self._receive(frame)
        self.requests.append(request)
        reply = self._receive(frame)
        return None if self.loses(request) else reply

    @property
    def writes(self) -> list[Message]:
        own = DELIXI_WRITES if self.sim.drive.model == "delixi-native" else WRITES
        return [request for request in self.requests if request.function in own]

    @property
    def starts(self) -> list[Message]:
        return [write for write in self.writes if STARTS[self.sim.drive.model](write)]


# ---- drives of every family in each of its framings, for one line ----


VARIANTS = (  # for `fast_drives`: family, framing, baud rate
    (ErmanERG220, Framing.RTU, 1_000_000),
    (InvtCHE, Framing.RTU, 500_000),
    (InnovertIBD, Framing.RTU, 500_000),
    (InnovertIBD, Framing.ASCII, 1_000_000),
    (DelixiModbus, Framing.RTU, 500_000),
    (DelixiModbus, Framing.ASCII, 1_000_000),
    (DelixiNative, Framing.DELIXI, 500_000),
    (YD1000, Framing.RTU, 1_000_000),
)
REASONS = {str(each) for each in Status} - {str(Status.OK)}
TIMEOUT = 0.02  # s; shortest reply timeout that a client learns from fast replies
LATEST = 3 * TIMEOUT


def real_drives() -> list[Drive]:
    return [
        family(address, name=f"{family.model} {framing}", framing=framing)
        for address, (family, framing, _) in enumerate(VARIANTS, 1)
    ]


def fast_drives() -> list[Drive]:
    """Return the drives with almost no character times and silences."""
    return [
        type(family.__name__, (family,), {"baudrates": (baudrate,), "needed_silence": lambda drive: 0.0})(
            address, name=f"{family.model} {framing}", framing=framing
        )
        for address, (family, framing, baudrate) in enumerate(VARIANTS, 1)
    ]


def real_wires() -> list[Wire]:
    return [Wire([EncodedDrive(drive) for drive in real_drives()])]


def of_one_variant(number: int) -> list[Drive]:
    """Return two drives of one family and framing."""
    family, framing, _ = VARIANTS[number]
    return [family(address, name=f"drive-{address}", framing=framing) for address in (1, 2)]


def of_all_variants() -> list[Drive]:
    return [
        family(address, name=f"drive-{address}", framing=framing)
        for address, (family, framing, _) in enumerate(VARIANTS, 1)
    ]


LINES = {f"{family.model} {framing}": number for number, (family, framing, _) in enumerate(VARIANTS)}
