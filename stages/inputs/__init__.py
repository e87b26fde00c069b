"""Shapes: one folder for every kind of input, behind one protocol."""
