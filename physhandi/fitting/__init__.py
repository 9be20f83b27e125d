"""Inverse physics: the stages of the paper."""
