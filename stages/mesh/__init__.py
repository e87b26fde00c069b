"""Polygon meshes, triangle meshes, polyhedral meshes and voxels, and what is computed from them."""
