"""From a textured mesh to what the denoiser trains on: triangulated copies and their latents, on disk."""

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex64
from tqdm import tqdm

from flx.config import Surface
from flx.mesh import copies
from flx.mesh.assets import Asset
from flx.mesh.formats.files import write_atomically
from flx.mesh.tables import load_tables, save_tables
from flx.mesh.texels import with_filled_gutters
from flx.pipeline.codec import Codec
from flx.types import MeshTables, TexturedMesh, Triangulation

MOST_WORKERS = 8  # a worker holds the mesh and its textures


class Prepared(NamedTuple):
    """A copy as training and sampling see it."""

    triangulation: Triangulation
    tables: MeshTables
    latents: Complex64[np.ndarray, "V D"]


class Cache(NamedTuple):
    """Prepared copies of one asset by one codec, a file for each seed."""

    folder: Path
    key: str

    def path(self, seed: int) -> Path:
        return self.folder / f"{self.key}-{seed:04d}.npz"

    def has(self, seed: int) -> bool:
        return self.path(seed).exists() and self._tables(seed).exists()

    def _tables(self, seed: int) -> Path:
        return self.path(seed).with_suffix(".tables.npz")

    def save(self, seed: int, copy: Prepared) -> None:
        save_tables(self._tables(seed), copy.tables)
        rest = {**copy.triangulation._asdict(), "latents": copy.latents}
        write_atomically(self.path(seed), lambda path: np.savez(path, **rest))

    def load(self, seed: int) -> Prepared:
        with np.load(self.path(seed), allow_pickle=False) as arrays:
            triangulation = Triangulation(arrays["vertices"], arrays["faces"])
            return Prepared(triangulation, load_tables(self._tables(seed)), arrays["latents"])


def open_cache(folder: Path, asset: Asset, surface: Surface, codec: Codec) -> Cache:
    """The cache of copies that hang on these contents and no others."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = (asset.digest, surface.vertices, surface.slots, codec.config, codec.digest())
    return Cache(folder, hashlib.sha256(repr(parts).encode()).hexdigest()[:12])


def prepare(cache: Cache, asset: Asset, surface: Surface, codec: Codec) -> None:
    """Make the copies that the cache lacks, in a process pool; each is there whole or not at all."""
    seeds = [surface.seed + k for k in range(surface.copies)]
    missing = [seed for seed in seeds if not cache.has(seed)]
    if not missing:
        return
    mesh = with_filled_gutters(asset.mesh)
    made = _copies(mesh, surface, codec.config.samples, missing)
    for seed, copy in tqdm(made, total=len(missing), desc="copies", unit="copy", dynamic_ncols=True):
        cache.save(seed, Prepared(copy.triangulation, copy.tables, codec.encode(copy.rings)))


def _copies(
    mesh: TexturedMesh, surface: Surface, samples: int, seeds: list[int]
) -> Iterator[tuple[int, copies.Copy]]:
    """Copies as they are ready. The pool spawns: forking a process that has started JAX can deadlock."""
    workers = min(MOST_WORKERS, os.cpu_count() or 1, len(seeds))
    if workers == 1:
        for seed in seeds:
            yield seed, copies.make_copy(mesh, surface.vertices, samples, surface.slots, seed)
        return
    with ProcessPoolExecutor(workers, get_context("spawn"), copies.begin, (mesh,)) as pool:
        args = (surface.vertices, samples, surface.slots)
        waiting = {pool.submit(copies.make_copy_here, *args, seed): seed for seed in seeds}
        try:
            for done in as_completed(waiting):
                yield waiting.pop(done), done.result()
        finally:
            pool.shutdown(cancel_futures=True)
