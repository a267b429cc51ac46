"""Adaptive refinement: the bisected elements, the finer mesh, and the nodes that it inserts."""
