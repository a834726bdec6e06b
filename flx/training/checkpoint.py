"""Checkpoints of a training state, written by Orbax in the background, complete or absent.

A save is written under another name and renamed when whole, so a kill during it leaves the one before. The
two newest stay. States are saved and restored as NumPy arrays: a checkpoint does not depend on the device
that made it, and the buffers of a saved state may be donated to the next step at once.
"""

from pathlib import Path
from typing import Any

import absl.logging
import jax
import numpy as np
import orbax.checkpoint as ocp

absl.logging.set_verbosity(absl.logging.WARNING)  # Orbax reports every save at INFO


class Checkpoints:
    """The checkpoints in one folder. Use it as a context: leaving it finishes the last save.

    The `writer` clears what a killed save left, so only one may exist at a time (`run.only_trainer`); a
    reader changes nothing.
    """

    def __init__(self, folder: Path, writer: bool = False):
        self.folder = folder
        options = ocp.CheckpointManagerOptions(max_to_keep=2, create=writer, cleanup_tmp_directories=writer)
        self._manager = ocp.CheckpointManager(folder.absolute(), options=options)

    def __enter__(self) -> "Checkpoints":
        return self

    def __exit__(self, *_: Any) -> None:
        self._manager.close()

    @property
    def latest_step(self) -> int | None:
        """The step of the newest complete checkpoint."""
        self.wait()
        return self._manager.latest_step()

    def save(self, step: int, state: Any) -> None:
        """Save a pytree of arrays in the background, as the state after `step` steps."""
        # On a CPU these are views; while one is alive, JAX gives a step that takes the state other buffers.
        self._manager.save(step, args=ocp.args.StandardSave(jax.device_get(state)))

    def restore_latest(self, template: Any) -> tuple[int, Any] | None:
        """The newest (step, state) as NumPy arrays in the structure of `template`, or None without any.

        The template's leaves are arrays or `jax.ShapeDtypeStruct`s. Raises ValueError where the checkpoint
        has others, or other shapes.
        """
        step = self.latest_step
        if step is None:
            return None
        host = jax.tree.map(lambda x: np.empty(x.shape, x.dtype), template)
        try:
            state = self._manager.restore(step, args=ocp.args.StandardRestore(host))
        except (ValueError, KeyError, TypeError) as error:  # Orbax's message lists both trees
            raise self._misfit(step, "its parameters have other names") from error
        # Orbax takes the shape on disk where the template's differs.
        for (path, leaf), wanted in zip(jax.tree.leaves_with_path(state), jax.tree.leaves(host), strict=True):
            if leaf.shape != wanted.shape:
                place = jax.tree_util.keystr(path)
                raise self._misfit(step, f"{place} has shape {leaf.shape}, not {wanted.shape}")
        return step, state

    def wait(self) -> None:
        """Block until the last save is on disk."""
        self._manager.wait_until_finished()

    def _misfit(self, step: int, fault: str) -> ValueError:
        return ValueError(
            f"{self.folder / str(step)} does not fit this network ({fault}); use the version of flx that "
            "made it, or train under another --name"
        )
