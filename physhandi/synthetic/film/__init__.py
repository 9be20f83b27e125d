"""Cameras, sensors and detectors that record a simulated scene."""
