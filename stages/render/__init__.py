"""Cameras, visibility, rasterised pictures and the neural shader."""
