"""Point clouds as input."""
