"""Laws of the sheet's material, one file each; `law.py` says how another is added."""

from jaxform.materials.law import Law, Slope, law
from jaxform.materials.mooney_rivlin import ModifiedMooneyRivlin, MooneyRivlin
from jaxform.materials.neo_hookean import NeoHookean

__all__ = ["Law", "ModifiedMooneyRivlin", "MooneyRivlin", "NeoHookean", "Slope", "law"]
