"""From a surface to an object to print."""
