"""Robustness: random scenes, the edge of stability, energy, gradients."""
