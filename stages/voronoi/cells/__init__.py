"""The cells of a bounded Voronoi diagram: generators, polyhedra, sizes, checks."""
