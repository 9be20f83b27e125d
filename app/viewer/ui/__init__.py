"""Basics of the viewer's parts: guarded callbacks, keys, and a viser server of their own."""
