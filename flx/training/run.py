"""Run folders: `runs/<config name>` holds all that one training made, and nothing of another.

`config.json` records every field of the experiment and the fingerprint of its asset. A folder is reopened
only by the same experiment on the same asset; else it is refused, never mixed. Three fields may change
between calls (`STEERING`). Of these, `train.steps` is the length of the cosine schedule too: a resumed run
takes its remaining steps at the learning rates of the new length.
Files appear whole or not at all, so that a kill at any moment leaves a folder that the next call can use.
"""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from flx import __version__
from flx.config import Experiment, FLDMExperiment, FLVAEExperiment, from_json
from flx.files import write_atomically

STEERING = ("train.steps", "train.log_every", "train.checkpoint_every")  # may change between calls
OPEN = ("model.latents", "model.invariants", "model.blocks")  # left open by records without a version
_KINDS = {kind.__name__: kind for kind in (FLVAEExperiment, FLDMExperiment)}


@dataclass(frozen=True)
class Run:
    """Where the parts of a run lie."""

    folder: Path

    @property
    def config(self) -> Path:
        return self.folder / "config.json"

    @property
    def asset(self) -> Path:
        """The folder of the copied asset."""
        return self.folder / "asset"

    @property
    def prepared(self) -> Path:
        return self.folder / "prepared"

    @property
    def checkpoints(self) -> Path:
        return self.folder / "checkpoints"

    @property
    def generator(self) -> Path:
        """The trained model as one file, of the newest checkpoint."""
        return self.folder / "generator.safetensors"

    @property
    def metrics(self) -> Path:
        return self.folder / "metrics.csv"

    @property
    def events(self) -> Path:
        """The folder of TensorBoard's events."""
        return self.folder / "events"

    @property
    def samples(self) -> Path:
        return self.folder / "samples"


def open_run(root: str | Path, experiment: Experiment, fingerprint: str) -> Run:
    """Create the folder `root/<experiment.name>`, or reopen it for the same experiment and asset.

    Raises ValueError where the name is no folder name, or the folder belongs to another experiment or asset.
    """
    name = experiment.name
    if Path(name).name != name or name in ("", ".."):
        raise ValueError(f"{name!r} names no folder; give the run a name without slashes with --name")
    run = Run(Path(root) / name)
    record = {
        "flx": __version__,
        "kind": type(experiment).__name__,
        "fingerprint": fingerprint,
        "config": asdict(experiment),
    }
    record = json.loads(json.dumps(record))  # as it reads back: tuples are lists
    if run.config.exists():
        _refuse_another(run, _read(run.config), record)
    elif strangers := _visible(run.folder):
        raise ValueError(
            f"{run.folder} has no config.json but holds {strangers[0]}; give the run another name with "
            f"--name, or delete {run.folder}"
        )
    write_atomically(run.config, (json.dumps(record, indent=2) + "\n").encode())
    return run


def load_config(folder: str | Path) -> Experiment:
    """The experiment that `folder/config.json` records; nothing in the file is executed.

    Raises ValueError where there is no such file, or a field is unknown, missing or of another type.
    """
    path = Run(Path(folder)).config
    if not path.exists():
        raise ValueError(f"{folder} is not a run: it has no config.json; give a folder that `flx train` made")
    record = _read(path)
    return from_json(_KINDS[record["kind"]], record["config"], f"{path}: config")


@contextlib.contextmanager
def only_trainer(run: Run) -> Iterator[None]:
    """Hold the run against a second trainer. The lock is the process's: it ends with it, however it ends.

    Raises ValueError where another process, or another part of this one, trains in this folder.
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    holder = run.folder / ".trainer"
    lock = FileLock(run.folder / ".lock", thread_local=False)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        number = holder.read_text().strip() if holder.exists() else "unknown"
        raise ValueError(
            f"{run.folder} is being trained by process {number}; wait for it, stop it, "
            "or give this run another name with --name"
        ) from None
    try:
        write_atomically(holder, str(os.getpid()).encode())
        yield
    finally:
        lock.release()


def _refuse_another(run: Run, old: dict[str, Any], new: dict[str, Any]) -> None:
    """Raise ValueError where a recorded run is not the one asked for."""
    changed = [d for d in _differences(old["config"], new["config"]) if d[0] != "name"]
    if "flx" not in old:  # it did not record what was left open
        changed = [d for d in changed if not (d[0] in OPEN and d[1] is None)]
    told = [f"{place} = {was}, not {now}" for place, was, now in changed if place not in STEERING]
    if old["kind"] != new["kind"]:
        told = [f"an {old['kind']}, not an {new['kind']}"]
    elif old["fingerprint"] != new["fingerprint"]:
        told.append(f"another asset (fingerprint {old['fingerprint']}, not {new['fingerprint']})")
    if told:
        raise ValueError(
            f"{run.folder} was made with {', '.join(told)}; give it another name with --name, "
            f"or delete {run.folder}"
        )
    for place, was, now in changed:
        if place == "train.steps":
            print(
                f"{run.folder}: train.steps {was} → {now}; its cosine schedule now has that length",
                file=sys.stderr,
            )


def _differences(old: Any, new: Any, place: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The (place, old, new) of every leaf that differs between two JSON values."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in dict.fromkeys([*old, *new]):
            inside = f"{place}.{name}" if place else name
            yield from _differences(old.get(name, "absent"), new.get(name, "absent"), inside)
    elif old != new:
        yield place, old, new


def _read(path: Path) -> dict[str, Any]:
    """Read a `config.json` and check its frame: kind, fingerprint, config."""
    try:
        record = json.loads(path.read_bytes())
        known = record["kind"] in _KINDS and isinstance(record["fingerprint"], str)
        if not known or not isinstance(record["config"], dict):
            raise KeyError("kind, fingerprint or config")
        if "flx" not in record and record["kind"] == "FLDMExperiment":
            record["config"]["model"] |= {"latents": None, "invariants": None}  # they were not the codec's
    except (ValueError, KeyError, TypeError) as error:
        message = f"{path} does not record a run ({error}); delete {path.parent} and train it again"
        raise ValueError(message) from None
    return record


def _visible(folder: Path) -> list[str]:
    """Names in a folder; hidden ones are locks and what a kill left of a file."""
    return sorted(p.name for p in folder.glob("*") if not p.name.startswith(".")) if folder.exists() else []
