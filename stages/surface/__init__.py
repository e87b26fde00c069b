"""The polygon mesh: flat arrays, geometry, topology."""
