"""Where codes are made on another mesh, or coarser or finer on the own one: as many vertices as keep the
texture's scale. The network knows lengths in mean vertex radii alone, so details grow with the triangles."""

import sys

from tqdm import tqdm

from flx.assets.asset import Asset
from flx.geometry.arrays import face_areas
from flx.geometry.remesh.remesh import remesh
from flx.geometry.tables import mesh_tables
from flx.pipeline.generator import Generator, Home

SAME_UNITS = 100.0  # factor between two areas above which they are taken for areas in different units
LEAST, MOST = 100, 200_000  # vertices
SLOTS = 64  # most neighbours: training keeps memory small with fewer, but one mesh may have an odd vertex


def home_on(generator: Generator, asset: Asset, scale: float = 1.0) -> Home:
    """The generator's own triangulation, or one of another asset or at another scale, as stderr then says.

    Raises ValueError where it would have too few or too many vertices, or cannot be made.
    """
    if asset.digest == generator.asset.digest and scale == 1:
        return generator.home
    count = vertex_count(generator, asset, scale)
    learnt = len(generator.home.triangulation.vertices)
    tqdm.write(in_words(learnt, generator.asset, asset, scale), file=sys.stderr)
    seed = generator.experiment.surface.seed
    try:
        triangulation = remesh(asset.mesh.vertices, asset.mesh.faces, count, seed)
    except ValueError as fault:
        raise ValueError(f"{asset.path}: {fault}, with a smaller --scale") from None
    return Home(triangulation, mesh_tables(triangulation, SLOTS, seed))


def vertex_count(generator: Generator, asset: Asset, scale: float = 1.0) -> int:
    """Vertices of a triangulation of the asset on which details are `scale` times as large as learnt.

    V · (area ratio) / scale²: equal mean vertex radii at scale 1. Areas that differ by a factor of more than
    `SAME_UNITS` say nothing, since meshes come in metres and in millimetres; then the ratio counts as 1.
    Raises ValueError for fewer than `LEAST` or more than `MOST`.
    """
    return scaled_count(len(generator.home.triangulation.vertices), generator.asset, asset, scale)


def scaled_count(learnt: int, source: Asset, asset: Asset, scale: float) -> int:
    """`vertex_count` where `source` has `learnt` vertices."""
    ratio = _area(asset) / _area(source)
    ratio = ratio if 1 / SAME_UNITS <= ratio <= SAME_UNITS else 1.0
    count = round(learnt * ratio / scale**2)
    if not LEAST <= count <= MOST:
        bound, word = (LEAST, "less") if count < LEAST else (MOST, "more")
        wanted = scale * (max(count, 1) / bound) ** 0.5
        raise ValueError(
            f"{asset.path} at scale {scale:g} has {count:,} vertices, and needs {LEAST} to {MOST:,}; "
            f"give --scale {wanted:.3g} or {word}"
        )
    return count


def in_words(learnt: int, source: Asset, asset: Asset, scale: float = 1.0) -> str:
    """Both areas, what follows from them, and the number of vertices, in one line."""
    own, other, count = _area(source), _area(asset), scaled_count(learnt, source, asset, scale)
    size = "keep their size" if scale == 1 else f"are {scale:g} times as large"
    if not 1 / SAME_UNITS <= other / own <= SAME_UNITS:
        size += " relative to the whole mesh: areas so different are taken for other units"
    areas = f"area {other:.4g}, that of {source.path.name} {own:.4g}"
    vertices = f"{count:,} vertices for the {learnt:,} there"
    return f"{asset.path.name}: {areas}; {vertices}, so that details {size}"


def _area(asset: Asset) -> float:
    return float(face_areas(asset.mesh.vertices, asset.mesh.faces).sum())
