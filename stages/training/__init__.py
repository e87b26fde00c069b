"""Training of the surface: spheres on triangles and on polygons, and the paper's own training."""
