"""Permalinks, replays and files."""
