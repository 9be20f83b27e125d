"""Background fits as child processes."""
