"""The Voronoi diagram of generators, and the interface between the two kinds of them."""
