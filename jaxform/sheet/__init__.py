"""The sheet in a run: its state, its discretization, what of it is active and packed, the scheme in time."""
