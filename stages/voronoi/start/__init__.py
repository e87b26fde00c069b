"""The first generators, placed from the voxels of a shape."""
