"""The built-in families of drives, by the model names that plant files and the command line use."""

from multidrop.drive import Drive
from multidrop.families.delixi import DelixiModbus, DelixiNative
from multidrop.families.erman_er_g_220 import ErmanERG220
from multidrop.families.innovert_ibd import InnovertIBD
from multidrop.families.invt_che import InvtCHE
from multidrop.families.yd1000 import YD1000

__all__ = ["MODELS", "YD1000", "DelixiModbus", "DelixiNative", "ErmanERG220", "InnovertIBD", "InvtCHE"]

MODELS: dict[str, type[Drive]] = {
    family.model: family for family in (ErmanERG220, InvtCHE, InnovertIBD, DelixiModbus, DelixiNative, YD1000)
}
