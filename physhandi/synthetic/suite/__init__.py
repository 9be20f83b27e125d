"""Suites of sequences: methods, the cells they fill, and their scores."""
