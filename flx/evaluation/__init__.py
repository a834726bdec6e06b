"""Measuring: fidelity of textures, and the methods that flx is compared with."""
