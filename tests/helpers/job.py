"""A training whose batches have rows, on some of the devices of some processes; a script that tests start."""

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from flx.config import Train
from flx.stopping import ended_by_signals, keeping
from flx.training.devices import devices_for
from flx.training.hosts import Host, joined
from flx.training.loop import LossFn, kept, train
from flx.training.run import Run

BATCH = 8
config = Train(steps=50, batch=BATCH, learning_rate=0.1, checkpoint_every=10, log_every=1, ema=0.9, seed=3)
INIT = {"w": np.linspace(-1, 1, 6, dtype=np.float32).reshape(3, 2), "b": np.zeros(2, np.float32)}


def loss_fn(params: Any, batch: Any, key: Any) -> Any:
    """A noisy regression; the noise of a row hangs on its number in the whole batch."""

    def one(row: Any, x: Any, y: Any) -> Any:
        x = x + 0.1 * jax.random.normal(jax.random.fold_in(key, row), x.shape)
        return jnp.mean((jnp.tanh(x @ params["w"] + params["b"]) - y) ** 2)

    return jnp.mean(jax.vmap(one)(batch["row"], batch["x"], batch["y"])), {}


def whole_batch(step: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([7, step])
    x, y = rng.standard_normal((BATCH, 3), np.float32), rng.random((BATCH, 2), np.float32)
    return {"row": np.arange(BATCH, dtype=np.int32), "x": x, "y": y}


def learn(folder: Path, host: Host, number: int | None = None, steps: int = 50, parts: int = 1) -> Any:
    """The state after these steps."""
    settings = replace(config, steps=steps, accumulate=parts)
    devices = devices_for(BATCH, parts, number, host)
    mine, run = devices.rows(BATCH), Run(folder)
    keeping(lambda: kept(run))

    def batches(step: int) -> Any:
        return {name: rows[mine] for name, rows in whole_batch(step).items()}

    loss: LossFn = loss_fn
    return train(run, settings, INIT, loss, batches, devices=devices)


if __name__ == "__main__":  # folder, steps, hosts or ""
    folder, steps, hosts = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3] or None
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "2"
    with ended_by_signals(), joined(hosts) as host:
        learn(folder, host, steps=steps)
