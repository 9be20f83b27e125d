"""What leaves the application: permalinks, replays and files."""
