"""Profiles: drive state machines that several makes share. A family adds its register addresses.

A family is a class that derives from a profile and declares its registers, or a file with
`profile = "…"`.
"""

from collections.abc import Mapping

from multidrop.families.profiles.command_codes import Delta, Inovance, Invt
from multidrop.families.profiles.iec_61800_7 import CiA402, Profidrive
from multidrop.families.profiles.profile import Profile, Role
from multidrop.families.profiles.run_bits import DanfossFC, Optidrive, Yaskawa

__all__ = [
    "PROFILES",
    "CiA402",
    "DanfossFC",
    "Delta",
    "Inovance",
    "Invt",
    "Optidrive",
    "Profidrive",
    "Profile",
    "Role",
    "Yaskawa",
]

PROFILES: Mapping[str, type[Profile]] = {
    "profidrive": Profidrive,
    "cia402": CiA402,
    "danfoss-fc": DanfossFC,
    "delta": Delta,
    "invt": Invt,
    "inovance": Inovance,
    "optidrive": Optidrive,
    "yaskawa": Yaskawa,
}
