"""File endings and the time limit of previews, shared by the server and what draws them."""

STILL, MOVING, NONE = ".still.webp", ".moving.webp", ".none"
"""Endings of the two pictures, and of the note that says why there are none."""
SECONDS_EACH = 60
"""Processor time that one preview may take [s]; by the clock it may be many times as much, as
everything else goes first."""
