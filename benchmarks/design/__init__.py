"""Gain of searches by gradient."""
