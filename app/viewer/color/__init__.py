"""Coloring: quantities, color scales and their legend."""
