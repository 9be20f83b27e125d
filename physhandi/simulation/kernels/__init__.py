"""Warp kernels; this package imports nothing but Warp."""
