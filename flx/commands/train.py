"""`flx train`: prepare and train what a config describes, or learn a mesh with the demo's settings."""

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from flx.arguments import briefly, path_of, whole
from flx.assets.formats.readers import READERS
from flx.config import Experiment, FLDMExperiment, FLVAEExperiment, quick, read_config
from flx.geometry.copies import check_memory

if TYPE_CHECKING:
    from flx.training.run import Run


def learn(
    experiment: Experiment,
    root: Path = Path("runs"),
    workers: int | None = None,
    devices: int | None = None,
    hosts: str | None = None,
) -> "Run":
    """Train what the experiment describes, resuming where it stopped; return its run.

    Args:
        experiment: An `FLDMExperiment` (one mesh) or an `FLVAEExperiment` (a folder of images).
        root: The folder of runs; the run's own is named after the experiment.
        workers: Processes that prepare the copies of a mesh; as many as processors and memory allow, at most
            8, unless given.
        devices: Devices that share the copies of a step; as many of this machine as can by default.
        hosts: Which of several processes this is, as "0/2@10.0.0.1:1234": the first of two, reached there;
            "auto" under Slurm, Open MPI, Kubernetes or on a TPU pod. Call it before anything is computed.

    Raises ValueError for an experiment that cannot be trained, or not on this machine, and where a run of
    that name is another one.

    Example:
        run = flx.train(flx.quick("bowl.glb", name="bowl"))
        generator = flx.load_generator(run.folder)
    """
    workers = None if workers is None else whole("--workers", workers, 1)
    root = path_of("root", root, "the folder of runs, such as 'runs'")
    if not isinstance(experiment, FLDMExperiment | FLVAEExperiment):
        given = briefly(experiment)
        raise ValueError(f"experiment is {given}; give an FLDMExperiment, such as flx.quick('bowl.glb')")
    devices = None if devices is None else whole("--devices", devices, 1)
    if isinstance(experiment, FLVAEExperiment):
        if hosts is not None or devices not in (None, 1):
            raise ValueError("an FL-VAE is trained on one device; leave out --devices and --hosts")
        from flx.training.flvae import learn_flvae

        return learn_flvae(experiment, root)
    check_memory(experiment.surface.vertices, experiment.surface.copies)
    from flx.training.fldm import learn_fldm
    from flx.training.hosts import joined

    with joined(hosts) as host:
        return learn_fldm(experiment, root, workers, devices, host)


def command(arguments: Sequence[str]) -> Callable[..., Callable[[], None]]:
    """The command for the config or mesh that the first argument names: its fields are the options.

    Raises ValueError where it names neither.
    """
    what = arguments[0] if arguments and not arguments[0].startswith("-") else ""
    default = _experiment(Path(what)) if what else quick()
    named = any(word.split("=")[0] == "--name" for word in arguments)

    def train(
        what: tyro.conf.Positional[Path],
        workers: int | None = None,
        devices: int | None = None,
        hosts: str | None = None,
        experiment: Annotated[type(default), tyro.conf.arg(name="")] = default,  # pyright: ignore
    ) -> Callable[[], None]:
        """Learn a mesh. The same command goes on where it was stopped.

        Example: flx train bowl.glb                                     the settings of the demo
                 flx train experiments/bowl.py --train.steps 500        those of a config

        Args:
            what: A mesh file (.glb, .gltf, .obj or .ply), or a config such as experiments/demo.py.
            workers: Processes that prepare the copies of a mesh; as many as processors and memory allow, at
                most 8, unless given.
            devices: Devices that share the copies of a step; as many of this machine as can by default.
            hosts: Which of several processes this is: 0/2@10.0.0.1:1234 is the first of two, which is reached
                there; auto under Slurm, Open MPI, Kubernetes or on a TPU pod.
        """
        chosen = experiment if named else _named_after_mesh(experiment, default)
        return lambda: _run(chosen, workers, devices, hosts)

    return train


def _named_after_mesh(experiment: Experiment, default: Experiment) -> Experiment:
    """The experiment with the name of its mesh, if that is another one than in the config."""
    if not isinstance(experiment, FLDMExperiment) or not isinstance(default, FLDMExperiment):
        return experiment
    ours, theirs = Path(experiment.surface.path).stem, Path(default.surface.path).stem
    return experiment if ours == theirs else replace(experiment, name=ours or "vase")


def _experiment(path: Path) -> Experiment:
    if path.suffix.lower() in READERS:
        return quick(str(path), path.stem)
    if path.suffix != ".py":
        raise ValueError(
            f"{path} is neither a mesh ({', '.join(READERS)}) nor a config; name one, such as bowl.glb or "
            "experiments/demo.py"
        )
    return read_config(path)


def _run(experiment: Experiment, workers: int | None, devices: int | None, hosts: str | None) -> None:
    run = learn(experiment, workers=workers, devices=devices, hosts=hosts)
    if isinstance(experiment, FLDMExperiment):
        print(
            f"{run.folder}: learnt; flx sample {shlex.quote(str(run.folder))} makes new textures",
            file=sys.stderr,
        )
    print(run.folder)
