"""The trained surface, its generators, their Voronoi diagram, and the certificate."""
