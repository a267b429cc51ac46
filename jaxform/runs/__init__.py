"""Loops over windows: `simulate`, `run`, batches; their arrays, and larger capacities where needed."""
