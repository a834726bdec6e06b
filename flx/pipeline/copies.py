"""From a textured mesh to what the denoiser trains on: triangulated copies and their latents, on disk."""

import contextlib
import hashlib
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex64, Float32
from tqdm import tqdm

from flx.arguments import check_kind, whole
from flx.assets.asset import Asset, check_asset
from flx.config import Surface
from flx.files import refuse_folder, write_atomically
from flx.geometry import copies
from flx.geometry.atlas import check_repeats, with_filled_gutters
from flx.pipeline.codec import Codec
from flx.pipeline.tensors import one_line
from flx.pipeline.workers import in_processes, workers_for
from flx.stopping import keeping
from flx.types import MeshTables, TexturedMesh, Triangulation


def triangulate(
    asset: Asset,
    vertices: int = 5000,
    seed: int = 0,
    samples: int = 64,
    slots: int = 16,
    triangulation: Triangulation | None = None,
) -> copies.Copy:
    """A random triangulation of the asset's surface, its gather tables, and colours in its one-rings.

    Args:
        asset: A mesh file from `flx.load`, or another asset.
        vertices: Their exact number; details smaller than a one-ring are lost.
        seed: Every seed gives another triangulation. Same seed, same machine: same bits. A mesh that was
            turned or moved may get another one, by rounding: to compare codes, give both the same.
        samples: Colours in each one-ring; 64 for the released FL-VAE.
        slots: The most neighbours of a vertex, itself included.
        triangulation: One of yours instead, on the asset's surface or close to it; `vertices` is not used.

    Raises ValueError where the surface has no triangulation of so few vertices, for more than fit into this
    machine's memory, and for a triangulation that is not a surface.

    Example:
        copy = flx.triangulate(asset, vertices=5000)
        latents = flx.load_codec().encode(copy.rings)  # [5000, 8], complex
    """
    check_asset("asset", asset)
    vertices, samples = whole("vertices", vertices, 4), whole("samples", samples, 1)
    seed, slots = whole("seed", seed), whole("slots", slots, 4)
    copies.check_memory(vertices)
    check_repeats(asset.mesh)
    if triangulation is not None:
        check_kind("triangulation", triangulation, Triangulation, "an flx.Triangulation(vertices, faces)")
        return copies.copy_on(with_filled_gutters(asset.mesh), triangulation, samples, slots, seed)
    return copies.make_copy(with_filled_gutters(asset.mesh), vertices, samples, slots, seed)


class Prepared(NamedTuple):
    """A copy as training and sampling see it."""

    triangulation: Triangulation
    tables: MeshTables
    latents: Complex64[np.ndarray, "V D"]  # the means of their posteriors
    deviations: Float32[np.ndarray, "V D"] | None = None  # σ of these, where codes are drawn


class Cache(NamedTuple):
    """Prepared copies of one asset by one codec, a file for each seed."""

    folder: Path
    key: str
    drawn: bool = False  # whether they hold deviations

    def path(self, seed: int) -> Path:
        return self.folder / f"{self.key}-{seed:04d}.npz"

    def has(self, seed: int) -> bool:
        return self.path(seed).exists() and self._tables(seed).exists()

    def _tables(self, seed: int) -> Path:
        return self.path(seed).with_suffix(".tables.npz")

    def save(self, seed: int, copy: Prepared) -> None:
        save_tables(self._tables(seed), copy.tables)
        rest = {**copy.triangulation._asdict(), "latents": copy.latents}
        rest |= {} if copy.deviations is None else {"deviations": copy.deviations}
        write_atomically(self.path(seed), lambda path: np.savez(path, **rest))

    def load(self, seed: int) -> Prepared:
        """Raises ValueError where a file of the copy is damaged."""
        with _arrays(self.path(seed), "prepared copy") as arrays:
            triangulation, latents = Triangulation(arrays["vertices"], arrays["faces"]), arrays["latents"]
            deviations = arrays["deviations"] if self.drawn else None
        return Prepared(triangulation, load_tables(self._tables(seed)), latents, deviations)

    def find(self, seed: int) -> Prepared | None:
        """The copy, or None where it is not there, or damaged, which is said on stderr."""
        if not self.has(seed):
            return None
        try:
            return self.load(seed)
        except ValueError as fault:
            print(f"{fault}; it is made again", file=sys.stderr)
            return None


def open_cache(folder: Path, asset: Asset, surface: Surface, codec: Codec, drawn: bool = False) -> Cache:
    """The cache of the copies that depend on exactly these contents; `drawn`: with deviations of codes."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = (asset.digest, surface.vertices, surface.slots, codec.config, codec.digest())
    parts += ("deviations",) * drawn
    return Cache(folder, hashlib.sha256(repr(parts).encode()).hexdigest()[:12], drawn)


def prepare(
    cache: Cache, asset: Asset, surface: Surface, codec: Codec, workers: int | None = None
) -> list[Prepared]:
    """The copies in the order of their seeds: those of the cache, and the others, which are made in several
    processes and put there; each file is there whole or not at all.

    `workers` is their number; as many as processors and free memory allow, at most 8, unless given.
    """
    seeds = range(surface.seed, surface.seed + surface.copies)
    found = {seed: cache.find(seed) for seed in seeds}
    copies = {seed: copy for seed, copy in found.items() if copy is not None}
    if not (missing := [seed for seed in seeds if seed not in copies]):
        return [copies[seed] for seed in seeds]

    def kept() -> str:
        there = f"{len(copies):,} of {len(seeds):,} copies are kept in {cache.folder}"
        return f"{there}; the same command makes the rest"

    keeping(kept)
    made = _copies(with_filled_gutters(asset.mesh), surface, codec.config.samples, missing, workers)
    bar = tqdm(made, total=len(missing), desc="copies", unit="copy", dynamic_ncols=True)
    with contextlib.closing(made), contextlib.closing(bar):
        try:
            for seed, copy in bar:
                codes = codec.posterior(copy.rings) if cache.drawn else (codec.encode(copy.rings), None)
                prepared = Prepared(copy.triangulation, copy.tables, *codes)
                cache.save(seed, prepared)
                copies[seed] = prepared
        except (ChildProcessError, MemoryError) as death:
            kind = MemoryError if isinstance(death, MemoryError) else ChildProcessError
            raise kind(f"{death}; {kept()}, and --workers 1 needs the least memory") from death
    return [copies[seed] for seed in seeds]


def _copies(
    mesh: TexturedMesh, surface: Surface, samples: int, seeds: list[int], workers: int | None
) -> Generator[tuple[int, copies.Copy]]:
    """Copies as they are ready."""
    tasks = [(surface.vertices, samples, surface.slots, seed) for seed in seeds]
    workers = min(workers or workers_for(copies.memory_to_make(surface.vertices, mesh)), len(seeds))
    if workers == 1:
        for seed, task in zip(seeds, tasks, strict=True):
            yield seed, copies.make_copy(mesh, *task)
    else:
        for n, copy in in_processes(copies.make_copy, (mesh,), tasks, workers):
            yield seeds[n], copy


def save_tables(path: Path, tables: MeshTables) -> None:
    """Write an .npz whole or not at all: a reader never meets half a file."""
    levels = tables._asdict().items()
    arrays = {f"{level}.{name}": a for level, part in levels for name, a in part._asdict().items()}
    write_atomically(path, lambda torn: np.savez(torn, **arrays))


def load_tables(path: Path) -> MeshTables:
    """Read what `save_tables` wrote. Raises ValueError where the file is damaged or holds something else."""
    with _arrays(path, "mesh tables") as file:
        levels = MeshTables.__annotations__.items()
        return MeshTables(
            *(kind(*(file[f"{level}.{name}"] for name in kind._fields)) for level, kind in levels)
        )


@contextlib.contextmanager
def _arrays(path: Path, what: str) -> Iterator[Any]:
    """The arrays of an npz. Raises ValueError, naming the file, if it is damaged or lacks an array.

    Each array in it has a checksum. Raises IsADirectoryError for a folder, which cannot be made again.
    """
    refuse_folder(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            yield file
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path} holds no {what} ({one_line(error)})") from error
