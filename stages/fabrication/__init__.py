"""Objects to print, made from a surface or from cells."""
