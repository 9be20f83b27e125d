"""Inspection of clicked things and their values."""
