"""Results of a run: the formed part, its wall, its energies, and their description."""
