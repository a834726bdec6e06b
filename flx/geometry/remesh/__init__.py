"""Remeshing: `flx.geometry.remesh.remesh` is the whole, the other modules are its steps."""
