"""The equations of the paper: pure JAX functions without parameters."""
