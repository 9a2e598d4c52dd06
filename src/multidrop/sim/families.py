"""Choose the simulation class for a drive by its family or profile."""

from __future__ import annotations

from collections.abc import Mapping

from multidrop.drive.family import Drive
from multidrop.families.delixi import DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.profiles import (
    CiA402,
    DanfossFC,
    Delta,
    Inovance,
    Invt,
    Optidrive,
    Profidrive,
    Yaskawa,
)
from multidrop.families.yd1000 import YD1000
from multidrop.sim.che import SimulatedCHE
from multidrop.sim.delixi import SimulatedDelixi, SimulatedDelixiNative
from multidrop.sim.drive import SimulatedDrive
from multidrop.sim.erman import SimulatedERMAN
from multidrop.sim.ibd import SimulatedIBD
from multidrop.sim.profiles import (
    SimulatedCiA402,
    SimulatedDanfossFC,
    SimulatedDelta,
    SimulatedInovance,
    SimulatedInvt,
    SimulatedOptidrive,
    SimulatedProfidrive,
    SimulatedYaskawa,
)
from multidrop.sim.yd1000 import SimulatedYD1000

FAMILIES: Mapping[type[Drive], type[SimulatedDrive]] = {
    ErmanERG220: SimulatedERMAN,
    InvtCHE: SimulatedCHE,
    InnovertIBD: SimulatedIBD,
    DelixiModbus: SimulatedDelixi,
    DelixiNative: SimulatedDelixiNative,
    YD1000: SimulatedYD1000,
    Profidrive: SimulatedProfidrive,
    CiA402: SimulatedCiA402,
    DanfossFC: SimulatedDanfossFC,
    Delta: SimulatedDelta,
    Inovance: SimulatedInovance,  # listed before Invt, its base class
    Invt: SimulatedInvt,
    Optidrive: SimulatedOptidrive,
    Yaskawa: SimulatedYaskawa,
}


def simulated(drive: Drive, *, response_delay: float | None = None) -> SimulatedDrive:
    """Return a simulation of the drive; for a user's class or family file, a plain SimulatedDrive.

    Raises TypeError for a family instead of a drive.
    """
    if isinstance(drive, type):
        raise TypeError(f"{drive.__name__} is a family, not a drive: write {drive.__name__}(1) for address 1")
    kinds = (kind for family, kind in FAMILIES.items() if isinstance(drive, family))
    return next(kinds, SimulatedDrive)(drive, response_delay=response_delay)
