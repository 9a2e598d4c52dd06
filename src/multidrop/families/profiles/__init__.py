"""Profiles: drive state machines that several makes share. A family adds its register addresses.

A family is a class that derives from a profile and declares its registers, or a file with
`profile = "…"`.
"""

from collections.abc import Mapping

from multidrop.families.profiles.command_bits import CiA402, DanfossFC, Optidrive, Profidrive, Yaskawa
from multidrop.families.profiles.command_codes import Delta, Inovance, Invt
from multidrop.families.profiles.profile import Profile, Role

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
