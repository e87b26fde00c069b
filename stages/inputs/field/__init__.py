"""Implicit fields as input: built-in ones, formulas, functions, grids."""
