"""Two rollouts side by side or in one place, on one clock."""
