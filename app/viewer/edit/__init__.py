"""Editing: what is selected in the scene, and what is done to it."""
