"""The clock of a session: which frame is on the screen."""
