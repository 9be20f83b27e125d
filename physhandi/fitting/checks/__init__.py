"""Checks of recordings before a fit, and warnings about its result afterwards."""
