"""Profiles: state machines that many makes share; a family adds the addresses of its registers.

A family is a class that derives from one of these and declares the registers that the profile names, or a
file with `profile = "…"`.
"""

from collections.abc import Mapping

from multidrop.profiles.cia402 import CiA402
from multidrop.profiles.danfoss_fc import DanfossFC
from multidrop.profiles.delta import Delta
from multidrop.profiles.invt import Invt
from multidrop.profiles.optidrive import Optidrive
from multidrop.profiles.profidrive import Profidrive
from multidrop.profiles.profile import Profile
from multidrop.profiles.role import Role

__all__ = [
    "PROFILES",
    "CiA402",
    "DanfossFC",
    "Delta",
    "Invt",
    "Optidrive",
    "Profidrive",
    "Profile",
    "Role",
]

PROFILES: Mapping[str, type[Profile]] = {
    "profidrive": Profidrive,
    "cia402": CiA402,
    "danfoss-fc": DanfossFC,
    "delta": Delta,
    "invt": Invt,
    "optidrive": Optidrive,
}
