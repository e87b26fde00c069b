"""Remeshing of closed triangle surfaces, and the edge lengths at which it aims."""
