"""What is measured of a surface."""
