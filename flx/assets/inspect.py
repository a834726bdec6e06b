"""A closer look at an asset: other maps, overlapping charts, inside-out parts, pixels in a one-ring."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int

from flx.assets.asset import Asset
from flx.assets.formats import gltf
from flx.assets.formats.files import BadFile
from flx.assets.formats.gltf import Gltf
from flx.assets.formats.images import bits_of, open_image
from flx.assets.formats.readers import load_beside
from flx.geometry.arrays import face_areas
from flx.geometry.atlas import uv_areas
from flx.geometry.raster import barycentric_planes, pixels_inside
from flx.geometry.topology import edges_of, label_components
from flx.types import Slot

RASTER = 1024  # pixels on the longer side of the raster in which texels are counted
MOST_PIXELS = 1 << 22  # of the raster that the surface may cover, counting repetitions
WITHIN = 1e-6  # least barycentric of a pixel inside a face; neighbours share those on their edge


class OtherMap(NamedTuple):
    """An image of another slot than the base colour; 0 × 0 if it is missing or cannot be read."""

    slot: Slot
    name: str
    width: int
    height: int
    bits: int  # per channel


def other_maps(asset: Asset) -> list[OtherMap]:
    """The maps of other slots in the file, read or not; none is decoded."""
    return [_other_map(asset, slot, name) for slot, names in asset.map_names.items() for name in names]


def _other_map(asset: Asset, slot: Slot, name: str) -> OtherMap:
    try:
        if isinstance(asset.container, Gltf):
            content = gltf.image_bytes(asset.container, int(name.rpartition("#")[2]))
        else:
            content = load_beside(asset.path.parent, name)
        image = open_image(content, name)
        return OtherMap(slot, name, image.width, image.height, bits_of(image))
    except (BadFile, OSError):
        return OtherMap(slot, name, 0, 0, 0)


def texel_counts(asset: Asset) -> dict[int, Int[Any, "_ _"]]:
    """How many faces show each texel, for each texture that is not flat, on a raster of at most 1,024²."""
    mesh, counted = asset.mesh, {}
    areas = np.abs(uv_areas(mesh))
    for index, (image, texture) in enumerate(zip(mesh.textures, asset.textures, strict=True)):
        if texture.flat:
            continue
        chosen = mesh.face_textures == index
        scale = min(1.0, RASTER / max(image.shape[:2]))
        pixels = areas[chosen].sum() * image.shape[0] * image.shape[1] * scale**2
        scale *= min(1.0, (MOST_PIXELS / max(pixels, 1.0)) ** 0.5)
        height, width = (max(1, round(side * scale)) for side in image.shape[:2])
        counts = np.zeros(height * width, np.int64)
        corners = mesh.corner_uvs[chosen] * [width, height] - 0.5
        barycentrics = barycentric_planes(corners)
        for triangles, columns, rows in pixels_inside(corners):
            own = barycentrics(triangles, columns, rows).min(0) > WITHIN
            place = rows[own] % height * width + columns[own] % width
            counts += np.bincount(place, minlength=len(counts))
        counted[index] = counts.reshape(height, width)
    return counted


def coverage(asset: Asset, counts: dict[int, Int[Any, "_ _"]] | None = None) -> tuple[float, float]:
    """The share of texels that the surface uses, and of these the share that it uses more than once."""
    every = (texel_counts(asset) if counts is None else counts).values()
    shown, doubled = (sum(int((one > least).sum()) for one in every) for least in (0, 1))
    return shown / max(sum(one.size for one in every), 1), doubled / max(shown, 1)


def inside_out_components(asset: Asset) -> int:
    """Closed components whose signed volume is negative."""
    vertices, faces = asset.mesh.vertices, asset.mesh.faces
    topo = edges_of(faces, len(vertices))
    number, component = label_components(topo.edges, len(vertices))
    closed = np.ones(number, bool)
    closed[component[topo.edges[topo.boundary, 0]]] = False
    a, b, c = np.moveaxis((vertices - vertices.mean(0))[faces], 1, 0)
    volumes = np.bincount(component[faces[:, 0]], np.einsum("fx,fx->f", a, np.cross(b, c)))
    return int((closed & (volumes < 0)).sum())


def ring_pixels(asset: Asset, painted: Bool[Any, "F"], vertices: int) -> tuple[float, float, float] | None:
    """Pixels of the texture in a one-ring (3/V of the surface) of a copy: 5 %, median, 95 % of the area."""
    areas = face_areas(asset.mesh.vertices, asset.mesh.faces)
    sizes = np.array([image.shape[0] * image.shape[1] for image in asset.mesh.textures] or [0])
    pixels = np.abs(uv_areas(asset.mesh)) * sizes[asset.mesh.face_textures]
    chosen = painted & (areas > 0)
    if not chosen.any():
        return None
    ring = 3 * areas.sum() / vertices * pixels[chosen] / areas[chosen]
    order = np.argsort(ring)
    share = np.cumsum(areas[chosen][order])
    marks = np.searchsorted(share, np.array([0.05, 0.5, 0.95]) * share[-1])
    low, median, high = ring[order][np.minimum(marks, len(order) - 1)].tolist()
    return low, median, high
