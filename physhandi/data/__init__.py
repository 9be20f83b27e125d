"""Recordings, and the files of runs."""
