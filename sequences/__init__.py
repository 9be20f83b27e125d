"""The sequences that ship with the project; see README.md."""
