"""The creases of an input."""
