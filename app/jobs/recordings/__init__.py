"""Work on recordings while the server runs: imports, and masks and tracks from clicks."""
