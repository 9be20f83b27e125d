"""Measures of quality, written apart from the losses."""
