"""Checkpoints of a training state, written by Orbax: the folder `40` holds the state after 40 steps.

Each folder is there whole or not at all, so a kill during a save leaves the checkpoint before. Beside Orbax's
files lies a digest of the state: what was damaged is never restored. The two newest stay; where the newest is
damaged, the one before it is restored. States are saved and restored as NumPy arrays: a checkpoint does not
depend on the device that made it.
"""

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import absl.logging
import jax
import numpy as np
import orbax.checkpoint as ocp

from flx.files import TORN, naming_a_full_disk
from flx.pipeline.tensors import Tensors, content_digest, one_line

KEPT = 2
STATE, DIGEST = "default", "digest"  # in a checkpoint's folder
absl.logging.set_verbosity(absl.logging.FATAL)  # Orbax reports every save, and more than one line of a fault


class Checkpoints:
    """The checkpoints in one folder. Only one process may save there (`run.only_trainer`)."""

    def __init__(self, folder: Path):
        self.folder = folder

    @property
    def latest_step(self) -> int | None:
        """The step of the newest checkpoint."""
        return max(self._found(), default=None)

    def save(self, step: int, state: Any) -> None:
        """Save a pytree of arrays as the state after `step` steps; it is on disk when this returns."""
        tensors = _named(jax.device_get(state))
        for torn in self.folder.glob(f"{TORN}*"):  # only one process saves here
            shutil.rmtree(torn)
        torn = self.folder / f"{TORN}{os.getpid()}.{step}"
        with naming_a_full_disk(self.folder / str(step)):
            with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as writer:
                writer.save((torn / STATE).absolute(), tensors)
            (torn / DIGEST).write_text(content_digest(tensors, str(step)))
            if (self.folder / str(step)).exists():  # a damaged one
                shutil.rmtree(self.folder / str(step))
            torn.rename(self.folder / str(step))
        found = self._found()
        # What is ahead of this state was damaged: the training went on from before it.
        stale = [n for n in found if n > step] + sorted(n for n in found if n <= step)[:-KEPT]
        for n in stale:
            shutil.rmtree(found[n])

    def restore_latest(self, template: Any) -> tuple[int, Any] | None:
        """The newest (step, state) that is whole, as NumPy arrays in the structure of `template`.

        None without any. The template's leaves are arrays or `jax.ShapeDtypeStruct`s. A damaged checkpoint is
        named on stderr. Raises ValueError where all are damaged, and where the newest whole one has leaves of
        other names or shapes.
        """
        found, faults = self._found(), []
        for step in sorted(found, reverse=True):
            try:
                tensors = _read(found[step], step)
            except ValueError as fault:
                faults.append(f"{found[step]} is damaged ({fault})")
                continue
            for fault in faults:
                print(f"{fault}; it goes on from step {step}, the checkpoint before", file=sys.stderr)
            return step, _shaped(tensors, template, found[step])
        if faults:
            raise ValueError(f"{faults[0]}, and none is before it; restore it, or train under another --name")
        return None

    def _found(self) -> dict[int, Path]:
        """The checkpoints by their step; an empty folder is none."""
        folders = [path for path in self.folder.glob("*") if path.is_dir() and any(path.iterdir())]
        return {int(path.name): path for path in folders if path.name.isascii() and path.name.isdecimal()}


def _alone() -> ocp.options.MultiprocessingOptions:
    """Orbax waits for no other process: one saves and restores for all."""
    if jax.process_count() == 1:
        return ocp.options.MultiprocessingOptions()
    mine = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        mine, active_processes={mine}, barrier_sync_key_prefix=str(mine)
    )


def _named(state: Any) -> Tensors:
    """The leaves by the names of their places."""
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree.leaves_with_path(state)}


def _shaped(tensors: Tensors, template: Any, path: Path) -> Any:
    """The state; ValueError where its leaves have other names, shapes or types than the template's."""
    leaves = jax.tree.leaves_with_path(template)
    wanted = {jax.tree_util.keystr(place): (leaf.shape, leaf.dtype) for place, leaf in leaves}
    there = {name: (leaf.shape, leaf.dtype) for name, leaf in tensors.items()}
    fault = ""
    if there.keys() != wanted.keys():
        fault = "its parameters have other names"
    elif odd := next((name for name in wanted if there[name] != wanted[name]), ""):
        (shape, kind), (ours, our_kind) = there[odd], wanted[odd]
        fault = (
            f"{odd} has shape {shape}, not {ours}" if shape != ours else f"{odd} is {kind}, not {our_kind}"
        )
    if fault:
        raise ValueError(
            f"{path} does not fit this network or its optimiser ({fault}); use the version of flx that made "
            "it, or train under another --name"
        )
    return jax.tree.unflatten(jax.tree.structure(template), [tensors[name] for name in wanted])


def _read(path: Path, step: int) -> Tensors:
    """Raises ValueError, with a reason in one line, for a damaged checkpoint."""
    try:
        with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as reader:
            there: Any = reader.metadata((path / STATE).absolute()).item_metadata
            host = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in there.tree.items()}
            tensors: Tensors = reader.restore((path / STATE).absolute(), host)
        if (path / DIGEST).read_text() != content_digest(tensors, str(step)):
            raise ValueError("its content is not what was written")
    except Exception as error:  # Orbax may raise anything
        raise ValueError(one_line(error)) from None
    return tensors
