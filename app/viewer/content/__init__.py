"""Contents of scenes: a recording, a run, its rollouts and the state of a session."""
