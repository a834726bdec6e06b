"""A user's file, read and written back unchanged but for its maps; never imports jax."""
