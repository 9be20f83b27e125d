"""Disk space: how much of it may be used, and what may go."""
