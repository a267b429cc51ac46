"""Sticking contact: which nodes can meet which triangles, when they do, and where they land."""
