"""What is known of previews by the server and the process that draws them: endings, and a limit."""

STILL, MOVING, NONE = ".still.webp", ".moving.webp", ".none"
"""Endings of the two pictures, and of the note that says why there are none."""
SECONDS_EACH = 60
"""Processor time that one preview may take [s]; by the clock it may be many times as much, as
everything else goes first."""
