"""What there is to show: a recording, a run, its rollouts and the state of a session."""
