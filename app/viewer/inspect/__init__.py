"""What was clicked, and its values."""
