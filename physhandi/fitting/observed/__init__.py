"""Estimates from the observation of an object: places of its tracks, and its state."""
