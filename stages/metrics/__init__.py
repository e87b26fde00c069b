"""Figures and checks of surfaces and cells."""
