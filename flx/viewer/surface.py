"""A mesh as the page draws it: rows of small numbers, faces in groups of one material, seams of its atlas.

Positions are steps of 1/65,535 of the longest side of the box, normals steps of 1/127: a page is for looking
at. It puts the middle of the box at 0 and the farthest vertex at distance 1, so that every mesh has the same
size on the screen, as in the pictures that flx makes (`flx.geometry.render`).
"""

import base64
import zlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int, UInt16

from flx.assets.asset import Asset
from flx.assets.formats.gltf import Gltf
from flx.assets.tints import face_materials, tints
from flx.geometry.arrays import distinct_rows
from flx.geometry.render import corner_normals
from flx.geometry.seams import seam_corners
from flx.types import TexturedMesh

STEPS = 65_535  # along the longest side of the box


class Look(NamedTuple):
    """What is done with the colours of a material's faces: glTF's words."""

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of the image, in linear light
    opacity: float | int = 1.0
    alpha_mode: str = "OPAQUE"
    cutoff: float | int = 0.5


class Rows(NamedTuple):
    """The rows of a mesh, one for each vertex, texture coordinate and normal that occur together."""

    vertices: Int[Any, "R"]  # the original vertex of each row
    positions: UInt16[Any, "R 3"]
    normals: Int[Any, "R 3"]
    uvs: Float64[Any, "R 2"]
    faces: Int[Any, "F 3"]


class Surface(NamedTuple):
    """A mesh for the page."""

    data: dict[str, Any]  # as JSON holds it: numbers, and arrays as `packed` makes them
    vertices: Int[Any, "R"]  # the original vertex of each row, which carries its colour


def surface(asset: Asset) -> Surface:
    """The asset's mesh for the page."""
    mesh = asset.mesh
    rows, low, step = rows_of(mesh, asset.corner_vertices)
    middle = (mesh.vertices.min(0) + mesh.vertices.max(0)) / 2
    radius = float(np.linalg.norm(mesh.vertices - middle, axis=1).max()) or 1.0
    materials, images = face_materials(asset), mesh.face_textures
    order = np.lexsort([images, materials])
    pairs = np.stack([materials, images], 1)[order]
    starts = np.flatnonzero(np.r_[True, (pairs[1:] != pairs[:-1]).any(1)])
    counts = np.diff(starts, append=len(pairs))
    factors = {tint.material: tint.factor for tint in tints(asset)}
    groups = [
        {"start": int(start), "count": int(count), "image": int(image)}
        | look(asset, int(material), factors)._asdict()
        for (material, image), start, count in zip(pairs[starts], starts, counts, strict=True)
    ]
    corners = seam_corners(mesh).ravel()
    after = corners - corners % 3 + (corners + 1) % 3
    data = {
        "positions": packed(rows.positions),
        "normals": packed(rows.normals.astype(np.int8)),
        "uvs": packed(rows.uvs.astype(np.float32)) if mesh.textures else None,
        "faces": packed(rows.faces[order].astype(np.uint32)),
        "seams": packed(rows.faces.ravel()[np.stack([corners, after], 1)].astype(np.uint32)),
        "groups": groups,
        "scale": STEPS * step / radius,
        "offset": ((low - middle) / radius).tolist(),
    }
    return Surface(data, rows.vertices)


def rows_of(mesh: TexturedMesh, corner_vertices: Int[Any, "F 3"]) -> tuple[Rows, Float64[Any, "3"], float]:
    """The rows, the low corner of the box, and the length of a step of the positions.

    `corner_vertices`: the original vertex of each corner, which carries its colour in a mesh without images.
    """
    low, step = mesh.vertices.min(0), max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300) / STEPS
    normals = np.rint(corner_normals(mesh) * 127).astype(np.int64).reshape(-1, 3)
    uvs = mesh.corner_uvs.reshape(-1, 2)
    first, place = distinct_rows(uvs)
    if not mesh.textures:
        first, place, uvs = np.zeros(1, np.int64), np.zeros(len(normals), np.int64), np.zeros((1, 2))
    key = np.stack([mesh.faces.ravel(), corner_vertices.ravel(), place, *(normals.T + 127)], 1)
    chosen, which = distinct_rows(key)
    positions = np.rint((mesh.vertices[key[chosen, 0]] - low) / step).astype(np.uint16)
    rows = Rows(key[chosen, 1], positions, normals[chosen], uvs[first][key[chosen, 2]], which.reshape(-1, 3))
    return rows, low, step


def packed(array: np.ndarray, level: int = 6) -> str:
    """The bytes of an array, little-endian, deflated at a level of zlib, in base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    return base64.b64encode(zlib.compress(little.tobytes(), level)).decode()


def look(asset: Asset, material: int, factors: Mapping[int, Sequence[float | int]]) -> Look:
    """The look of a material; `factors` are those of tinted ones.

    The colour of a material without an image is in the image that flx made of it.
    """
    paint = asset.paints[material]
    if not isinstance(asset.container, Gltf):
        return Look(opacity=paint.opacity, alpha_mode=paint.alpha_mode)
    entries = asset.container.document.get("materials", [])
    entry = entries[material] if material < len(entries) else {}
    opacity = entry.get("pbrMetallicRoughness", {}).get("baseColorFactor", [1, 1, 1, 1])[3]
    mode, cutoff = entry.get("alphaMode", "OPAQUE"), entry.get("alphaCutoff", 0.5)
    red, green, blue = map(float, factors.get(material, (1, 1, 1)))
    return Look((red, green, blue), opacity, mode, cutoff)
