"""Hands and spring-mass objects from sparse-view RGB-D video."""

__version__ = "0.1.0"
