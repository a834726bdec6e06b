"""Run folders: `runs/<config name>` holds all that one training made, and nothing of another.

`config.json` records every field of the experiment and the fingerprint of its asset. A folder is reopened
only by the same experiment on the same asset; any other is refused. Some fields may change between calls
(`STEERING`), and the files of the asset may have been moved. `train.steps` is also the length of the cosine
schedule: a resumed run takes its remaining steps at the learning rates of the new length.
Files appear whole or not at all, so that a kill at any moment leaves a folder that the next call can use.
"""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

from filelock import FileLock, Timeout

from flx import __version__
from flx.assets.formats.files import read_file
from flx.config import Experiment, from_json, with_added
from flx.files import check_place, write_atomically
from flx.pipeline.tensors import one_line

# What each field that may change between calls does to the training; "" for nothing.
STEERING = {
    "train.steps": "its cosine schedule now has that length",
    "train.batch": "it goes on with that batch",
    "train.accumulate": "",
    "surface.copies": "it goes on with that many",  # only more: the seeds of the first ones stay the same
    "surface.up": "",
    "train.log_every": "",
    "train.checkpoint_every": "",
}
# The fingerprint says what is there.
PLACES = (
    "surface.path",
    "surface.texture",
    "surface.labels",
    "surface.direction",
    "surface.fill",
    "weights",
    "images.folder",
)
OPEN = ("model.latents", "model.invariants", "model.blocks")  # left open by records without a version
_KINDS = {kind.__name__: kind for kind in get_args(Experiment)}


@dataclass
class Run:
    """The paths of a run's parts."""

    folder: Path

    def __post_init__(self) -> None:
        self.config = self.folder / "config.json"
        self.asset = self.folder / "asset"  # a folder: the run's copy of its asset
        self.prepared = self.folder / "prepared"
        self.checkpoints = self.folder / "checkpoints"
        self.generator = self.folder / "generator.safetensors"  # the trained model, at the newest checkpoint
        self.metrics = self.folder / "metrics.csv"
        self.events = self.folder / "events"  # a folder, for TensorBoard
        self.previews = self.folder / "previews"  # a folder, of `flx watch`


def open_run(root: str | Path, experiment: Experiment, fingerprint: str) -> Run:
    """Create the folder `root/<experiment.name>`, or reopen it for the same experiment and asset.

    Raises ValueError if the name is not a folder name, or too long for one, if the folder belongs to another
    experiment or asset, if there is a link in it, and while somebody trains there.
    """
    name = experiment.name
    if Path(name).name != name or name in ("", ".."):
        raise ValueError(f"{name!r} is not a folder name; give the run a name without slashes with --name")
    run = Run(Path(root) / name)
    check_place(run.config, "give the run another name with --name")
    _refuse_links(run.folder)
    record = {"flx": __version__, "kind": type(experiment).__name__, "fingerprint": fingerprint}
    record |= {"config": json.loads(json.dumps(asdict(experiment)))}  # as it reads back: tuples are lists
    if run.config.exists():
        _refuse_another(run, _read(run.config), record)
    elif strangers := _visible(run.folder):
        raise ValueError(
            f"{run.folder} has no config.json but holds {strangers[0]}; give the run another name with --name"
        )
    with only_trainer(run):
        write_atomically(run.config, (json.dumps(record, indent=2) + "\n").encode())
    return run


def load_config(folder: str | Path) -> Experiment:
    """The experiment that `folder/config.json` records; nothing in the file is executed.

    Raises ValueError where there is no such file, where a field is unknown, missing or of another type, and
    where a link is in the folder.
    """
    path = Run(Path(folder)).config
    _refuse_links(path.parent)
    if not path.exists():
        raise ValueError(f"{folder} is not a run: it has no config.json; give a folder that `flx train` made")
    record = _read(path)
    return from_json(_KINDS[record["kind"]], record["config"], f"{path}: config")


@contextlib.contextmanager
def only_trainer(run: Run) -> Iterator[None]:
    """Lock the run against a second trainer. The lock ends with the process, however that ends.

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


def _refuse_links(folder: Path) -> None:
    """Raise ValueError where there is a link in a run's folder, which may be a stranger's: what is written or
    cleared through it lies elsewhere."""
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            if path.is_symlink():
                raise ValueError(f"{path} is a link; put what it leads to in its place, or train another run")


def _refuse_another(run: Run, old: dict[str, Any], new: dict[str, Any]) -> None:
    """Raise ValueError where the recorded run is another one than the new record describes."""
    changed = [d for d in _differences(old["config"], new["config"]) if d[0] != "name"]
    if "flx" not in old:  # an earlier version, which did not record what was left open
        changed = [d for d in changed if not (d[0] in OPEN and d[1] is None)]
    moved = old["fingerprint"] == new["fingerprint"]
    faults = [f"{p} = {was}, not {now}" for p, was, now in changed if not _is_harmless(p, was, now, moved)]
    if old["kind"] != new["kind"]:
        faults = [f"an {old['kind']}, not an {new['kind']}"]
    elif old["fingerprint"] != new["fingerprint"]:
        faults.append(f"another asset (fingerprint {old['fingerprint'][:12]}, not {new['fingerprint'][:12]})")
    if faults:
        raise ValueError(
            f"{run.folder} was made with {', '.join(faults)}; give the new run another name with --name"
        )
    for place, was, now in changed:
        if effect := STEERING.get(place):
            print(f"{run.folder}: {place} {was} → {now}; {effect}", file=sys.stderr)


def _is_harmless(place: str, was: Any, now: Any, moved: bool) -> bool:
    """Whether a run may go on with another value; `moved`: what it learns from is the same, if elsewhere."""
    if place in PLACES:
        # The run's copy of the mesh is found by the mesh's name.
        return moved and (not place.startswith("surface") or Path(was or "").name == Path(now or "").name)
    return place in STEERING and (place != "surface.copies" or now > was)


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
        record = json.loads(read_file(path))
        known = record["kind"] in _KINDS and isinstance(record["fingerprint"], str)
        if not known or not isinstance(record["config"], dict):
            raise KeyError("kind, fingerprint or config")
        if "flx" not in record and record["kind"] == "FLDMExperiment":
            record["config"]["model"] |= {"latents": None, "invariants": None}  # they were not the codec's
        record["config"] = with_added(_KINDS[record["kind"]], record["config"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        message = (
            f"{path} does not record a run ({one_line(error)}); restore it, or train under another --name"
        )
        raise ValueError(message) from None
    return record


def _visible(folder: Path) -> list[str]:
    """Names in a folder, without the hidden ones: locks, and files that a kill cut short."""
    return sorted(p.name for p in folder.glob("*") if not p.name.startswith(".")) if folder.exists() else []
