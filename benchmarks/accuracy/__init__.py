"""Accuracy: against exact and independent solutions, and what an error costs in time."""
