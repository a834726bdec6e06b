"""Labels from files, and what a generator knows of them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int32

from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.assets.formats.images import decode_image
from flx.assets.formats.readers import READERS
from flx.assets.read import read_asset
from flx.assets.unwrap import NEW_CHARTS
from flx.geometry.labels import LabelMap, Palette, corner_labels, hexadecimal, image_labels, shares
from flx.types import MeshTables, TexturedMesh

SAME = 0.05  # of the size of a mesh, by which another that holds its labels may lie elsewhere


class Labels(NamedTuple):
    """The labels that a network learnt, and where they are on its own copy of the mesh."""

    palette: Palette
    numbers: Int32[Any, "V"]


def read_labels(path: Path, asset: Asset, palette: Palette | None = None) -> LabelMap:
    """The labels of an asset's surface.

    Args:
        path: An image of flat colours on the asset's own UVs, of any size; or a mesh file of the same surface
            with flat vertex colours (a PLY).
        palette: The labels that were learnt, if they are to be found again.

    Raises ValueError for a file that holds no labels, or others than were learnt.
    """
    if not path.exists():
        raise ValueError(f"labels {path} do not exist; paint flat colours on a copy of the texture")
    try:
        if path.suffix.lower() in (".gltf", ".obj"):
            raise ValueError("its colours may lie in other files; give a PLY with flat vertex colours")
        if path.suffix.lower() in READERS:
            return corner_labels(_same_surface(path, asset.mesh), palette)
        if not asset.textures or asset.textures[0].made_from == NEW_CHARTS:
            raise ValueError(
                f"{asset.path} has no texture coordinates; give labels as a PLY's vertex colours"
            )
        return image_labels(asset.mesh, decode_image(read_file(path), path.name)[0], palette)
    except ValueError as fault:
        raise ValueError(f"labels {path}: {fault}") from None


def _same_surface(path: Path, mesh: TexturedMesh) -> TexturedMesh:
    """The mesh of a file that lies where another one does. Raises ValueError where it does not."""
    other = read_asset(path).mesh
    if other.textures:
        raise ValueError("a mesh with a texture; give the image itself, or a PLY of vertex colours")
    (low, high), theirs = ((m.vertices.min(0), m.vertices.max(0)) for m in (mesh, other))
    if np.abs(np.subtract(theirs, (low, high))).max() > SAME * np.linalg.norm(high - low):
        raise ValueError("it lies elsewhere than the mesh that it labels; export both from one scene")
    return other


def one_hot(numbers: Int32[Any, "V"], count: int) -> Float32[Any, "V m"]:
    """ρ of labels: 1 for a vertex's own."""
    return np.eye(count, dtype=np.float32)[numbers]


def in_words(labels: Labels, tables: MeshTables) -> str:
    """How many labels there are, and the share of the surface that each has, in a line."""
    areas = shares(labels.numbers, np.asarray(tables.fine.masses, np.float64), len(labels.palette))
    each = (f"{hexadecimal(c)} {share:.1%}" for c, share in zip(labels.palette, areas, strict=True))
    return f"{len(areas)} labels, by area {', '.join(each)}"
