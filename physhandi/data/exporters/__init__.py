"""Runs, turned into files that other programs read."""
