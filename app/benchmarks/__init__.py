"""Benchmarks of the running application."""
