"""The `flx` command: one launcher for everything.

  flx doctor MESH          what is in a mesh file, and what would be repaired
  flx train CONFIG.py      prepare (cached) and train; the same command resumes
  flx sample RUN           new textures from a run
  flx reconstruct MESH     a texture through the FL-VAE and back, with its metrics
  flx evaluate             a table: how well each method keeps the textures of some meshes
  flx bench                timings of this machine

Exit status: 0 done, 1 failed on the way, 2 wrong input. Errors are one line; `--verbose` adds the traceback.
"""

import json
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from flx.config import Compared, FLDMExperiment, read_config

# JAX is imported inside the commands: `--help` and `doctor` stay quick, and the processes that build
# copies of a mesh import this file too.

Positional = tyro.conf.Positional


def doctor(
    mesh: Positional[Path],
    /,
    texture: Path | None = None,
    config: Path | None = None,
    vertices: int | None = None,
    json: bool = False,
) -> None:
    """Say what is in a mesh file, what would be repaired and what a run would take. Writes nothing.

    Example: flx doctor bowl.glb --config experiments/bowl.py

    Args:
        mesh: A .glb, .gltf, .obj or .ply file.
        texture: An image to use instead of the file's own.
        config: The run that is planned, as for `flx train`; the paper's unless given.
        vertices: Of the planned run; the config's unless given.
        json: Print one JSON object.
    """
    from flx.assets.read import read_asset
    from flx.commands.doctor import describe, examine

    plan = FLDMExperiment() if config is None else read_config(config)
    if not isinstance(plan, FLDMExperiment):
        raise ValueError(f"{config} trains no mesh; give a config such as experiments/demo.py")
    if vertices is not None:
        plan = replace(plan, surface=replace(plan.surface, vertices=vertices))
    try:
        asset = read_asset(mesh, texture)
    except (ValueError, OSError) as refusal:
        if json:
            print(_json({"path": str(mesh), "verdict": f"refused: {refusal}"}))
        raise
    findings = examine(asset, plan)
    found = {**asset.report._asdict(), **findings._asdict(), "plan": findings.plan._asdict()}
    print(_json(found) if json else describe(asset.report, findings))


def sample(
    run: Positional[Path],
    /,
    count: int = 4,
    seed: int = 0,
    sampler: Literal["ancestral", "ddim"] = "ddim",
    steps: int = 50,
    texture_size: int | None = None,
    out: Path | None = None,
    format: Literal["glb", "obj", "ply"] = "glb",
) -> None:
    """Make new textures: variation_00.glb ..., their atlases, a contact sheet and samples.json.

    Example: flx sample runs/demo --count 4

    Args:
        run: A run folder of `flx train`.
        count: How many variations.
        seed: Variation n hangs on the seed and n alone.
        sampler: "ancestral" takes all steps of the schedule, "ddim" as many as `steps`.
        steps: Steps of the DDIM sampler.
        texture_size: Pixels on the atlas' longer side; the input's, at most 2048, unless given.
        out: Folder to write to; RUN/samples unless given.
        format: "glb" keeps all that a GLB or glTF held, "obj" all of an OBJ; "ply" holds vertex colours.
    """
    from flx.commands.sample import sample as draw

    print(draw(run, count, seed, sampler, steps, texture_size, out, format))


def reconstruct(
    mesh: Positional[Path],
    /,
    vertices: int = 30_000,
    texture: Path | None = None,
    texture_size: int | None = None,
    weights: str | None = None,
    up: Literal["y", "z"] = "y",
    seed: int = 0,
    out: Path | None = None,
    format: Literal["glb", "obj", "ply"] = "glb",
) -> None:
    """Send a texture through the FL-VAE and back, and print its metrics as JSON.

    Example: flx reconstruct bowl.glb --vertices 30000 --out bowl-there-and-back

    Args:
        mesh: A .glb, .gltf, .obj or .ply file.
        vertices: Of the triangulation that carries the latents.
        texture: An image to use instead of the file's own.
        texture_size: Pixels on the atlas' longer side; the input's, at most 2048, unless given.
        weights: An FL-VAE file; the released one unless given.
        up: The axis that points up in the pictures.
        seed: Of the triangulation.
        out: Folder to write to; MESH-VERTICES unless given.
        format: "glb" keeps all that a GLB or glTF held, "obj" all of an OBJ; "ply" holds vertex colours.
    """
    from flx.commands.reconstruct import reconstruct as there_and_back

    print(_json(there_and_back(mesh, vertices, texture, texture_size, weights, seed, up, out, format)))


def evaluate(
    reconstruction: tuple[str, ...],
    out: Path,
    vertices: tuple[int, ...] = (30_000, 5_000),
    methods: tuple[Compared, ...] = get_args(Compared),
    images: Path | None = None,
    weights: str | None = None,
    texture_size: int | None = None,
    seed: int = 0,
    atlases: bool = False,
) -> None:
    """Measure methods side by side: table.json and table.md. Rows that are there already are kept.

    Example: flx evaluate --reconstruction bowl.glb can.glb --vertices 30000 5000 --images photos --out table

    Args:
        reconstruction: Whose textures are sent there and back: MESH, MESH:TEXTURE, or an image as a sheet.
        out: Folder to write to.
        vertices: Of the triangulations; one row each.
        methods: Which methods to measure.
        images: Folder of images that pca and frame_pca are fitted to; they are left out without it.
        weights: An FL-VAE file; the released one unless given.
        texture_size: Pixels on the atlas' longer side; the input's, at most 2048, unless given.
        seed: Of the triangulations.
        atlases: Write each new row's texture too.
    """
    from flx.evaluation.reconstruction import markdown, reconstruction_table

    rows = reconstruction_table(
        reconstruction, vertices, methods, images, weights, texture_size, seed, out, atlases
    )
    print(markdown(rows), end="")


def bench(path: Positional[Path | None] = None, /, mesh: bool = False, texture: Path | None = None) -> None:
    """Time this machine and print one JSON object.

    Example: flx bench --mesh > bench.json

    Args:
        path: A .glb, .gltf, .obj or .ply file for --mesh; the vase that flx makes itself unless given.
        mesh: Time the geometry (CPU seconds) instead of the networks.
        texture: An image to use instead of the file's own.
    """
    from flx.commands.bench import codec_rows, denoiser_rows, machine, mesh_rows

    if path is not None and not mesh:
        raise ValueError(f"{path} is for --mesh; the networks are timed without a file")
    rows = mesh_rows(path, texture) if mesh else [*codec_rows(), *denoiser_rows()]
    print(_json({"rows": rows, "machine": machine()}))


def train(arguments: Sequence[str]) -> None:
    """flx train CONFIG.py [--train.steps 2000 ...]: every field of the config is an option."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(train.__doc__)
        print("\nExample: flx train experiments/demo.py --train.steps 500\n")
        print("flx train CONFIG.py --help lists the fields of that config.")
        return
    path, rest = Path(arguments[0]), list(arguments[1:])
    experiment = read_config(path)
    experiment = tyro.cli(
        Annotated[type(experiment), tyro.conf.arg(name="")],  # pyright: ignore
        prog=f"flx train {path}",
        default=experiment,
        args=rest,
    )
    from flx.commands.train import learn

    run = learn(experiment, Path("runs"))
    if isinstance(experiment, FLDMExperiment):
        print(f"{run.folder}: learnt; flx sample {run.folder} makes new textures", file=sys.stderr)
    print(run.folder)


COMMANDS: dict[str, Callable[..., None]] = {
    "doctor": doctor,
    "train": train,
    "sample": sample,
    "reconstruct": reconstruct,
    "evaluate": evaluate,
    "bench": bench,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    verbose = "--verbose" in words
    words = [word for word in words if word != "--verbose"]
    if not words or words[0] in ("-h", "--help"):
        print(__doc__)
        return 0 if words else 2
    if words[0] == "--version":
        print(f"flx {version('flx')}")
        return 0
    if words[0] not in COMMANDS:
        return _complain(f"there is no command {words[0]!r}; say one of {', '.join(COMMANDS)}", 2)
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        if words[0] == "train":
            train(words[1:])
        else:
            tyro.cli(COMMANDS[words[0]], prog=f"flx {words[0]}", args=words[1:])
    except (ValueError, OSError, FloatingPointError, MemoryError) as error:
        if verbose:
            traceback.print_exc()
        wrong_input = isinstance(error, ValueError | FileNotFoundError | IsADirectoryError)
        return _complain(" ".join(str(error).split()) or type(error).__name__, 2 if wrong_input else 1)
    return 0


def _complain(message: str, status: int) -> int:
    print(f"flx: {message}", file=sys.stderr)
    return status


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, indent=2)


if __name__ == "__main__":
    sys.exit(main())
