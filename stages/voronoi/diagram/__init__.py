"""The Voronoi diagram of generators, and the interface between inside and outside cells."""
