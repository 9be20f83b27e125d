"""An object whose hand a user moves: what is simulated, what is told by keys, and the panel."""
