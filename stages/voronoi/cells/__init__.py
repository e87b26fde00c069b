"""Voronoi cells that end at a surface: inner generators, polyhedra, sizes and checks."""
