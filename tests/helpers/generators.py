"""Small generators of a coloured ball."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from helpers.surfaces import icosphere

from flx.assets.arrays import from_arrays
from flx.assets.asset import Asset, own_painting
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.config import FLDM, FLDMExperiment, Surface
from flx.fields.diffusion import Scaling
from flx.geometry.direction import field_on
from flx.geometry.labels import labels_on
from flx.geometry.tables import mesh_tables
from flx.models.denoiser.depth import complete
from flx.models.denoiser.unet import schedule
from flx.pipeline.codec import load_codec
from flx.pipeline.generator import Generator, Home, Source, learnt_generator, parameter_shapes
from flx.pipeline.labels import Labels, read_labels
from flx.types import MeshTables, Triangulation

BALL = icosphere(2)
COLORS = np.random.default_rng(0).integers(0, 256, (162, 3))


def colored_sphere(sphere: Triangulation = BALL, colors: np.ndarray = COLORS) -> bytes:
    """A PLY of coloured vertices: 162, unless another sphere is given."""
    rows = [
        f"{x} {y} {z} {r} {g} {b}"
        for (x, y, z), (r, g, b) in zip(sphere.vertices, colors.tolist(), strict=True)
    ]
    rows += [f"3 {a} {b} {c}" for a, b, c in sphere.faces]
    head = ["ply", "format ascii 1.0", f"element vertex {len(colors)}"]
    head += [f"property double {axis}" for axis in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    head += [f"element face {len(sphere.faces)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join([*head, *rows, ""]).encode()


def labelled_sphere(sphere: Triangulation = BALL) -> bytes:
    """The same in three flat colours, by height."""
    colors = np.array([(0, 0, 0), (200, 0, 0), (0, 0, 200)])
    return colored_sphere(sphere, colors[np.digitize(sphere.vertices[:, 2], [-0.4, 0.5])])


def ball_generator(folder: Path, labelled: bool = False, direction: str = "") -> Generator:
    """An untrained one whose answers are not small; its asset is written to `folder`, and its labels."""
    (folder / "ball.ply").write_bytes(colored_sphere())
    asset = read_asset(folder / "ball.ply")
    codec, sphere = load_codec(), icosphere(2)
    surface = Surface(path="/home/anna/secret/ball.ply", vertices=162, copies=1, up="z", direction=direction)
    small = FLDM(channels=4, embedding=8, precision="float32", steps=20)
    model = complete(small, codec.config, 162, 3 * labelled, int(bool(direction)))
    experiment = FLDMExperiment(model=model, surface=surface, weights="/home/anna/secret/codec.safetensors")
    tables = mesh_tables(sphere)
    params = drawn_parameters(parameter_shapes(model, tables))
    scaling = Scaling(np.arange(8).astype(np.complex64), np.full(8, 2 - 1j, np.complex64))
    files = {"files/ball.ply": colored_sphere()}
    labels, place = None, None
    if labelled:
        kernel = params["params"]["embedding"]["RealDense_0"]["kernel"]
        params["params"]["embedding"]["RealDense_0"]["kernel"] = kernel.at[-3:].multiply(30)
        files[place := "labels/zones.ply"] = labelled_sphere()
        (folder / "zones.ply").write_bytes(files[place])
        found = read_labels(folder / "zones.ply", asset)
        labels = Labels(found.palette, labels_on(found, sphere))
    source = Source("files/ball.ply", None, asset.digest, files, place)
    field = field_on(direction, sphere) if direction else None
    rest = Home(sphere, tables), source, 7, labels, field
    return learnt_generator(experiment, params, scaling, codec, *rest)


def drawn_parameters(shapes: Any) -> Any:
    """Parameters of a network as it might have learnt them; to initialise it would be to compile it."""
    rng = np.random.default_rng(1)

    def drawn(path: tuple, shape: jax.ShapeDtypeStruct) -> jax.Array:
        noise = rng.normal(size=shape.shape)
        if path[-1].key == "kernel":
            return jnp.asarray(1.2 * noise / np.sqrt(2 * shape.shape[-2]), shape.dtype)
        return jnp.asarray({"scale": 1, "size": 0.3}.get(path[-1].key, 0) + 0.1 * noise, shape.dtype)

    return jax.tree.map_with_path(drawn, shapes)


def textured_ball() -> Asset:
    """A sphere seen from above and from below: two charts, side by side, on a texture of 64 × 96 pixels."""
    corners = BALL.vertices[BALL.faces]
    below = corners.mean(1)[:, 2] < 0
    uvs = corners[..., :2] * [0.15, 0.22] + [0.25, 0.5] + below[:, None, None] * [0.5, 0.0]
    rows, columns = np.mgrid[:64, :96]
    waves = [np.sin(columns / 3) + np.cos(rows / 4), np.cos(columns / 5), np.sin(rows / 5 + columns / 7)]
    return from_arrays(*BALL, uvs, np.rint(127 + 60 * np.stack(waves, -1)).astype(np.uint8))


def noise_in(params: Any, tables: MeshTables, z: jax.Array, t: jax.Array, seen: Any = None) -> jax.Array:
    """Stands in for a network; it costs nothing to compile, and minds what it is told."""
    told = 0 if seen is None else 0.1 * (seen.rho @ jnp.ones((3, 8)) * jnp.arange(8) + seen.direction)
    return 0.9 * z + told


def function_generator(folder: Path) -> Generator:
    """Of the textured ball, with labels and the direction z; `noise_in` is its network.

    The files are written to `folder`.
    """
    asset = textured_ball()
    write(asset, own_painting(asset), folder / "ball.glb")
    (folder / "zones.ply").write_bytes(labelled_sphere())
    asset = read_asset(folder / "ball.glb")
    found = read_labels(folder / "zones.ply", asset)
    names = {"files/ball.glb": "ball.glb", "labels/zones.ply": "zones.ply"}
    files = {place: (folder / name).read_bytes() for place, name in names.items()}
    codec = load_codec()
    scaling = Scaling(np.zeros(8, np.complex64), np.full(8, 1 + 1j, np.complex64))
    model = complete(FLDM(steps=200), codec.config, 162, 3, 1)
    return Generator(
        noise_in,
        {},
        schedule(model),
        scaling,
        codec,
        Home(BALL, mesh_tables(BALL)),
        Source("files/ball.glb", None, asset.digest, files, "labels/zones.ply"),
        FLDMExperiment(model=model, surface=Surface(vertices=162, up="z")),
        7,
        Labels(found.palette, labels_on(found, BALL)),
        field_on("z", BALL),
    )
