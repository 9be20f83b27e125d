"""Measurements of speed that print JSON."""
