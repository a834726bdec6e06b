"""Checkpoints of a training state: `40.safetensors` holds the state after 40 steps.

Each file is there whole or not at all, so a kill during a save leaves the checkpoint before. The two newest
stay; where the newest is damaged, the one before it is restored. States are saved and restored as NumPy
arrays: a checkpoint does not depend on the device that made it.
"""

import shutil
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from flx.pipeline.tensors import Tensors, load_tensors, one_line, save_tensors

KEPT = 2


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
        save_tensors(
            self.folder / f"{step}.safetensors", _named(jax.device_get(state)), "checkpoint", str(step)
        )
        found = self._found()
        # What is ahead of this state was damaged: the training went on from before it.
        stale = [n for n in found if n > step] + sorted(n for n in found if n <= step)[:-KEPT]
        for n in stale:
            shutil.rmtree(found[n]) if found[n].is_dir() else found[n].unlink()

    def restore_latest(self, template: Any) -> tuple[int, Any] | None:
        """The newest (step, state) that is whole, as NumPy arrays in the structure of `template`.

        None without any. The template's leaves are arrays or `jax.ShapeDtypeStruct`s. A damaged checkpoint is
        named on stderr. Raises ValueError where all are damaged, and where the newest whole one has leaves of
        other names or shapes.
        """
        found, faults = self._found(), []
        for step in sorted(found, reverse=True):
            try:
                tensors = _read(found[step], template)
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
        """The checkpoints by their step. Those of earlier versions are folders; an empty one is none."""
        paths = sorted(self.folder.iterdir()) if self.folder.is_dir() else []
        stems = {path: path.name.removesuffix(".safetensors") for path in paths}
        whole = {path: stem for path, stem in stems.items() if not path.is_dir() or any(path.iterdir())}
        return {int(stem): path for path, stem in whole.items() if stem.isascii() and stem.isdecimal()}


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
            f"{path} does not fit this network ({fault}); use the version of flx that made it, or train "
            "under another --name"
        )
    return jax.tree.unflatten(jax.tree.structure(template), [tensors[name] for name in wanted])


def _read(path: Path, template: Any) -> Tensors:
    """Raises ValueError, with a reason in one line, for a damaged checkpoint."""
    return _read_folder(path, template) if path.is_dir() else load_tensors(path, "checkpoint")[1]


def _read_folder(path: Path, template: Any) -> Tensors:
    """A checkpoint of an earlier version, in the layout of Orbax, which has no digest."""
    import absl.logging
    import orbax.checkpoint as ocp

    absl.logging.set_verbosity(absl.logging.FATAL)  # Orbax reports more than one line
    host = jax.tree.map(lambda x: np.empty(x.shape, x.dtype), template)
    try:
        with ocp.StandardCheckpointer() as reader:
            return _named(reader.restore((path / "default").absolute(), host))
    except Exception as error:  # it may raise anything
        raise ValueError(one_line(error)) from None
