"""What was recorded, and what a run leaves behind."""
