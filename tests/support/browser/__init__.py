"""Pages in a browser: scenes, accessibility, pictures small enough to be made fast."""
