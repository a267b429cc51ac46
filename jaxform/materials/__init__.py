"""Laws of the sheet's material, one file each; `law.py` says how another is added."""

from jaxform.materials.cooling import Cooling
from jaxform.materials.gent import Gent
from jaxform.materials.law import Law, PlaneLaw, Slope, law
from jaxform.materials.mooney_rivlin import ModifiedMooneyRivlin, MooneyRivlin
from jaxform.materials.neo_hookean import NeoHookean
from jaxform.materials.ogden import Ogden
from jaxform.materials.shift import SHIFTS, Arrhenius, ArrheniusStiffness, Shift, Wlf
from jaxform.materials.viscous import MODES, Christensen, Maxwell, Modes, Recursion
from jaxform.materials.yeoh import Yeoh

LAWS: dict[str, type[Law]] = {
    "neo-hookean": NeoHookean,
    "mooney-rivlin": MooneyRivlin,
    "modified-mooney-rivlin": ModifiedMooneyRivlin,
    "yeoh": Yeoh,
    "gent": Gent,
    "ogden": Ogden,
}
"""Those that a scene file names."""

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
    "Wlf",
    "Yeoh",
    "law",
]
