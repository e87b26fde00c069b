"""The first generators, from the voxels of a shape."""
