"""Recordings, networks and meshes that tests make or read."""
