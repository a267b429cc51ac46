"""Triangle meshes on the host, in NumPy: shapes, reading and writing, topology, bisection. It alone knows meshio."""
