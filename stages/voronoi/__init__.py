"""Diagrams, interfaces, cells, and how well surfaces conform to them."""
