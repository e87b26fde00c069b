"""Questions to a mesh: closest points, what is inside, thickness, crossing triangles."""
