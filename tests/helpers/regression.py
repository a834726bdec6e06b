"""A noisy regression: the smallest thing that a training loop can train."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flx.config import Train

config = Train(steps=12, batch=4, learning_rate=0.1, checkpoint_every=5, log_every=1, ema=0.9, seed=3)
INIT = {"w": jnp.linspace(-1.0, 1.0, 6).reshape(3, 2), "b": jnp.zeros(2)}


def loss_fn(params: Any, batch: Any, key: Any) -> Any:
    """A noisy regression: it hangs on parameters, batch and key alike."""
    x = batch["x"] + 0.1 * jax.random.normal(key, batch["x"].shape)
    error = jnp.tanh(x @ params["w"] + params["b"]) - batch["y"]
    return jnp.mean(error**2), {"worst": jnp.max(jnp.abs(error))}


def batches(step: int) -> Any:
    rng = np.random.default_rng([7, step])
    return {"x": rng.standard_normal((4, 3), np.float32), "y": rng.random((4, 2), np.float32)}
