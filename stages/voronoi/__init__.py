"""Voronoi diagrams, the surface between generators inside and outside, and its certificate."""
