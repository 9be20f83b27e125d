"""Engines: what starts the processes of fits, here or on a cluster."""
