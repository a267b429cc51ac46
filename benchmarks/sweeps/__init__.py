"""Sweeps: what killed workers and clients cost, bits and programs of many designs, and the memory of a worker."""
