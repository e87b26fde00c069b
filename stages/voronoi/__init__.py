"""Voronoi diagrams: generators, interfaces, cells, and the certificate of a surface."""
