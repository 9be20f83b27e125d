"""Which frame is on the screen."""
