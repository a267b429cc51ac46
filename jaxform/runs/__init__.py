"""Loops over windows: `simulate`, `run`, batches; the arrays they work in, and more room where it is needed."""
