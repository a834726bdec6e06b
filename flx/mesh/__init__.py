"""Geometry: NumPy, SciPy and libigl in float64; never imports jax."""
