"""Timings of this machine for `flx bench`: rows of a name, seconds and bytes."""

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial import ConvexHull

from flx.assets.read import read_asset
from flx.assets.vase import vase_asset
from flx.config import FLDM, FLVAE, Filter
from flx.fields.algebra import squared_modulus, tangent_noise
from flx.geometry.atlas import atlas_texels
from flx.geometry.remesh.remesh import remesh
from flx.geometry.render import render
from flx.geometry.tables import mesh_tables
from flx.models.codec.vae import FieldLatentVAE
from flx.models.denoiser.vectors import Denoiser
from flx.pipeline.codec import initial_params, load_codec
from flx.types import MeshTables, Queries, RingSamples, Triangulation

PAPER_BLOCKS = (2, 4, 4)
VERTICES, TEXELS = 30_000, 1024**2  # encoded, decoded
RINGS = 128  # one-rings in a batch of the transformer
SIDE = 2048  # of the matrices whose product is the floor
ATLAS = 4096  # texels a side


def denoiser_rows() -> list[dict[str, Any]]:
    """One train step (loss, gradient, Adam) of the paper's network, batch 1, on a sphere of 2,562 vertices.

    `temp_bytes`: what XLA allocates in addition to parameters, optimiser and tables.
    """
    tables = jax.tree.map(jnp.asarray, mesh_tables(_sphere(2562)))
    return [_train_step(filter, tables) for filter in get_args(Filter)]


def codec_rows(repeats: int = 3) -> list[dict[str, Any]]:
    """The FL-VAE: the released one there and back, the paper's transformer, and the floor under both.

    The floor is what a large matrix product reaches; a row's GFLOP/s are what XLA counts, by the seconds.
    `peak_bytes`: of the process until then.
    """
    rng = np.random.default_rng(0)
    codec = load_codec()
    rings = _rings(VERTICES, codec.config.samples)
    z = np.asarray(tangent_noise(jax.random.key(0), (VERTICES, codec.config.latents)))
    corners = rng.integers(0, VERTICES, (TEXELS, 3)).astype(np.int32)
    logs = np.broadcast_to(np.complex64(0.5), corners.shape)
    points = Queries(corners, logs, rng.dirichlet(np.ones(3), TEXELS).astype(np.float32))
    rows = [_product(name, repeats) for name in ("float32", "bfloat16")]
    calls: list[tuple[str, Callable[[], Any], int]] = [
        ("encode", lambda: codec.encode(rings), VERTICES),
        ("decode", lambda: codec.decode(points, z), TEXELS),
    ]
    for name, call, count in calls:
        rows.append(_row(name, count, _median_seconds(call, repeats)) | {"peak_bytes": peak_bytes()})
    return [*rows, *_transformer(FLVAE(), repeats)]


def _product(precision: str, repeats: int) -> dict[str, Any]:
    x = jnp.ones((SIDE, SIDE), precision)
    product = jax.jit(lambda x: jnp.dot(x, x, preferred_element_type=jnp.float32))
    seconds = _median_seconds(lambda: jax.block_until_ready(product(x)), repeats)
    return {"name": f"product/{precision}", "seconds": seconds, "gflops": 2e-9 * SIDE**3 / seconds}


def _transformer(config: FLVAE, repeats: int) -> list[dict[str, Any]]:
    """The paper's encoder on a batch of one-rings, forward and with the gradient of its parameters."""
    model, params, rings = FieldLatentVAE(config), initial_params(config, 0), _rings(RINGS, config.samples)

    def size_of_codes(params: Any, rings: RingSamples) -> jax.Array:
        posterior: Any = model.apply(params, rings, method="encode")
        return jnp.sum(squared_modulus(posterior.mean))

    rows = []
    for name, function in (("forward", size_of_codes), ("gradient", jax.grad(size_of_codes))):
        compiled = jax.jit(function).lower(params, rings).compile()
        seconds = _median_seconds(lambda c=compiled: jax.block_until_ready(c(params, rings)), repeats)
        flops: Any = compiled.cost_analysis()
        gflops = 1e-9 * flops["flops"] / seconds
        rows.append(_row(f"transformer_{name}", RINGS, seconds) | {"gflops": gflops})
    return rows


def _row(name: str, count: int, seconds: float) -> dict[str, Any]:
    return {"name": f"{name}/{count}", "seconds": seconds, "per_second": round(count / seconds)}


def _rings(count: int, samples: int) -> RingSamples:
    """Random colours at random points."""
    rng = np.random.default_rng(1)
    logs = np.asarray(tangent_noise(jax.random.key(1), (count, samples)))
    return RingSamples(logs, rng.random((count, samples, 3), np.float32))


def _median_seconds(call: Callable[[], Any], repeats: int) -> float:
    """The median over the calls after the first, which compiles and warms up."""
    return statistics.median([_timed(call)[0] for _ in range(repeats + 1)][1:])


def mesh_rows(path: Path | None, texture: Path | None = None) -> list[dict[str, Any]]:
    """CPU seconds of each stage of the geometry on a mesh file, or on the vase.

    `peak_bytes` is the most memory that the process has held by the end of the stage. A mesh without textures
    has no atlas and no such row.
    """
    mesh = (vase_asset() if path is None else read_asset(path, texture)).mesh
    rows = []

    def timed(name: str, call: Callable[[], Any]) -> Any:
        start = time.process_time()
        result = call()
        seconds = time.process_time() - start
        rows.append({"name": name, "seconds": seconds, "peak_bytes": peak_bytes()})
        return result

    copy = timed(f"remesh/{VERTICES}", lambda: remesh(mesh.vertices, mesh.faces, VERTICES, seed=0))
    timed(f"tables/{VERTICES}", lambda: mesh_tables(copy))
    if mesh.textures:
        timed(f"texels/{ATLAS}", lambda: atlas_texels(mesh, 0, ATLAS, ATLAS))
    timed(f"render/{len(mesh.faces)} faces", lambda: render(mesh))
    return rows


def machine() -> dict[str, Any]:
    """What the timings were taken on."""
    device = jax.devices()[0]
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "device": device.device_kind,
        "python": platform.python_version(),
        "jax": jax.__version__,
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor()


def _train_step(filter: Filter, tables: MeshTables) -> dict[str, Any]:
    config = FLDM(latents=8, filter=filter)
    model, adam = Denoiser(config, PAPER_BLOCKS), optax.adam(1e-3)
    z = tangent_noise(jax.random.key(0), (len(tables.fine.masses), sum(config.code_channels)))
    t = jnp.float32(500.0)
    params = jax.jit(model.init)(jax.random.key(1), tables, z, t)

    def loss(params: Any) -> jax.Array:
        return jnp.mean(squared_modulus(jnp.asarray(model.apply(params, tables, z, t)) - z))

    def step(params: Any, state: Any) -> tuple[Any, Any, jax.Array]:
        value, gradient = jax.value_and_grad(loss)(params)
        updates, state = adam.update(gradient, state)
        return optax.apply_updates(params, updates), state, value

    state = adam.init(params)
    compile_seconds, compiled = _timed(lambda: jax.jit(step).lower(params, state).compile())
    return {
        "name": f"train_step/{filter}/{len(z)}",
        "seconds": _median_seconds(lambda: jax.block_until_ready(compiled(params, state)), 5),
        "compile_seconds": compile_seconds,
        "temp_bytes": compiled.memory_analysis().temp_size_in_bytes,
        "parameters": sum(p.size for p in jax.tree.leaves(params)),
    }


def _timed(call: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    result = call()
    return time.perf_counter() - start, result


def _sphere(count: int) -> Triangulation:
    """The convex hull of `count` points on a Fibonacci spiral: nearly all degrees are six."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    r = np.sqrt(1 - z * z)
    vertices = np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)
    faces = ConvexHull(vertices).simplices.astype(np.int64)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, [0, 2, 1]]
    return Triangulation(vertices, faces)


def peak_bytes() -> int | None:
    """The most memory that this process has held until now; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak << 10  # in KiB but on macOS
