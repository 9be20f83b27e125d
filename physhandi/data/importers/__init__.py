"""Recordings of other formats, turned into sequences."""
