"""Material models of the sheet, one file each; a new one is a file like `gent.py`, and its import here."""

from jaxform.materials.gent import Gent
from jaxform.materials.law import LAWS, Law, PlaneLaw, Slope, law
from jaxform.materials.mooney_rivlin import ModifiedMooneyRivlin, MooneyRivlin
from jaxform.materials.neo_hookean import NeoHookean
from jaxform.materials.ogden import Ogden
from jaxform.materials.temperature import SHIFTS, Arrhenius, ArrheniusStiffness, Cooling, Shift, Touching, Wlf
from jaxform.materials.viscous import MODES, Christensen, Maxwell, Modes, Recursion
from jaxform.materials.yeoh import Yeoh

__all__ = [
    "LAWS",
    "MODES",
    "SHIFTS",
    "Arrhenius",
    "ArrheniusStiffness",
    "Christensen",
    "Cooling",
    "Gent",
    "Law",
    "Maxwell",
    "Modes",
    "ModifiedMooneyRivlin",
    "MooneyRivlin",
    "NeoHookean",
    "Ogden",
    "PlaneLaw",
    "Recursion",
    "Shift",
    "Slope",
    "Touching",
    "Wlf",
    "Yeoh",
    "law",
]
