"""What comes out: the formed part, its wall, its energies, and what is said of them."""
