"""Flax modules: parameters and wiring."""
