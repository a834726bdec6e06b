"""Geometry: surfaces in NumPy, SciPy and libigl, float64; never imports jax."""
