"""Polygon and triangle meshes, and grids of voxels: data, and what follows from it alone."""
