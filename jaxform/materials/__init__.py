"""Material models of the sheet; a new one is a class like `Gent`, in a file of its own, and its import here."""

from jaxform.materials.invariants import Gent, ModifiedMooneyRivlin, MooneyRivlin, NeoHookean, Yeoh
from jaxform.materials.law import LAWS, Law, PlaneLaw, Slope, law
from jaxform.materials.ogden import Ogden
from jaxform.materials.temperature import SHIFTS, Arrhenius, ArrheniusStiffness, Cooling, Shift, Touching, Wlf
from jaxform.materials.viscous import MODES, Christensen, Maxwell, Modes, Recursion

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
