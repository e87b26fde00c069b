"""Triangle and polygon meshes as input."""
