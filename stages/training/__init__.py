"""Training of the surface: spheres on triangles and polygons, and the paper's own."""
