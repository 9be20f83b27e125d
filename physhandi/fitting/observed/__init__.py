"""What is told of the object from what was seen of it: places of its tracks, and its state."""
