"""Sequences made by simulation."""
