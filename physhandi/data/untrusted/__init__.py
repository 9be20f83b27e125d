"""Files that others made: read only with limits of memory and time, most in a child process."""
