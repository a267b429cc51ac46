"""Adaptive refinement: what is bisected, the finer mesh, and the nodes that it inserts."""
