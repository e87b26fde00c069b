"""Remeshing of closed triangle surfaces, and the edge lengths that it aims at."""
