"""Cameras, visibility and shading for pictures."""
