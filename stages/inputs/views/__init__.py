"""Calibrated photographs and drawings as input."""
