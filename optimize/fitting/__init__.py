"""Parameters of a material from tests: tension, relaxation and bubbles, fitted all at once."""

from optimize.fitting.outcome import Fit, Match
from optimize.fitting.procedure import fit
from optimize.fitting.tables import Bubble, Pull, Table, read_table

__all__ = ["Bubble", "Fit", "Match", "Pull", "Table", "fit", "read_table"]
