"""Live viser scenes."""
