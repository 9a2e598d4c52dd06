"""multidrop: poll every drive on an RS-485 line as fast as the wire allows."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from multidrop.interpreter import refuse_other_interpreters

if TYPE_CHECKING:
    from multidrop.bus import Bus as Bus
    from multidrop.control.audit_log import read_audit as read_audit
    from multidrop.control.eeprom_ledger import Ledger as Ledger
    from multidrop.control.outcome import Effect as Effect
    from multidrop.control.outcome import Outcome as Outcome
    from multidrop.control.ramp import ramp as ramp
    from multidrop.control.ramp import start_staggered as start_staggered
    from multidrop.drive.family import Drive as Drive
    from multidrop.drive.register import Register as Register
    from multidrop.drive.register import command as command
    from multidrop.drive.register import reading as reading
    from multidrop.drive.register import setting as setting
    from multidrop.drive.state import Condition as Condition
    from multidrop.drive.state import Direction as Direction
    from multidrop.drive.state import State as State
    from multidrop.drive.verbs import verb as verb
    from multidrop.drives import YD1000 as YD1000
    from multidrop.drives import DelixiModbus as DelixiModbus
    from multidrop.drives import DelixiNative as DelixiNative
    from multidrop.drives import ErmanERG220 as ErmanERG220
    from multidrop.drives import InnovertIBD as InnovertIBD
    from multidrop.drives import InvtCHE as InvtCHE
    from multidrop.errors import BadReply as BadReply
    from multidrop.errors import BusError as BusError
    from multidrop.errors import DriveRefused as DriveRefused
    from multidrop.errors import Expired as Expired
    from multidrop.errors import LineError as LineError
    from multidrop.errors import NoReply as NoReply
    from multidrop.errors import NotDone as NotDone
    from multidrop.errors import Overtaken as Overtaken
    from multidrop.errors import Refused as Refused
    from multidrop.errors import Unconfirmed as Unconfirmed
    from multidrop.errors import Unsupported as Unsupported
    from multidrop.plant.loader import PlantError as PlantError
    from multidrop.plant.loader import load_plant as load_plant
    from multidrop.plant.model import Plant as Plant
    from multidrop.plant.model import Polled as Polled
    from multidrop.plant.model import PolledDrive as PolledDrive
    from multidrop.poller import Poller as Poller
    from multidrop.polling.batch import Batch as Batch
    from multidrop.recording import convert as convert
    from multidrop.recording import open_reader as open_reader
    from multidrop.recording import open_writer as open_writer
    from multidrop.transport.statistics import Delays as Delays
    from multidrop.transport.statistics import Diagnostics as Diagnostics
    from multidrop.transport.statistics import LineStatistics as LineStatistics
    from multidrop.transport.statistics import Statistics as Statistics

refuse_other_interpreters()

# Every public name and the module that it comes from, which is loaded when the name is first used.
_HOMES = {
    "control.audit_log": ("read_audit",),
    "polling.batch": ("Batch",),
    "bus": ("Bus",),
    "drive": ("Condition", "Direction", "Drive", "State", "verb"),
    "drives": ("DelixiModbus", "DelixiNative", "ErmanERG220", "InnovertIBD", "InvtCHE", "YD1000"),
    "errors": (
        "BadReply",
        "BusError",
        "DriveRefused",
        "Expired",
        "LineError",
        "NoReply",
        "NotDone",
        "Overtaken",
        "Refused",
        "Unconfirmed",
        "Unsupported",
    ),
    "control.eeprom_ledger": ("Ledger",),
    "control.ramp": ("ramp", "start_staggered"),
    "control.outcome": ("Effect", "Outcome"),
    "plant.loader": ("PlantError", "load_plant"),
    "plant.model": ("Plant", "Polled", "PolledDrive"),
    "poller": ("Poller",),
    "recording": ("convert", "open_reader", "open_writer"),
    "drive.register": ("Register", "command", "reading", "setting"),
    "transport.statistics": ("Delays", "Diagnostics", "LineStatistics", "Statistics"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [*_HOME_OF]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'multidrop' has no attribute {name!r}")
    return getattr(import_module(f"multidrop.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME_OF])
