"""Queries about a mesh: closest points, inside or outside, thickness, crossing triangles."""
