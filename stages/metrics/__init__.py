"""Metrics and checks of surfaces and of cells."""
