"""Which point of a surface each texel shows, and images painted at those texels.

Texture coordinates run right and down, and textures repeat. Texel (row, column) has its centre at
u = (column + ½)/W, v = (row + ½)/H, so u·W − ½ is a column. Colours are float32 in [0, 1], images have 8 or
16 bits. Work is done in chunks, so memory is bounded by the result, not by the mesh.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int32, UInt
from numpy.typing import DTypeLike
from scipy.ndimage import distance_transform_edt

from flx.arguments import counted
from flx.geometry.arrays import chunks, dot
from flx.geometry.color import quantized
from flx.geometry.raster import CHUNK, Pixels, Planes, barycentric_planes, expand, pixels_inside
from flx.types import Layer, Slot, SurfacePoints, TexturedMesh

MOST_REPEATS = 16  # repeats of a texture on one face; billions would take too long and show no more
WRAP = 8  # texels beyond the border of a repeating texture in which a gutter looks for colours
Picture = UInt[Any, "H W 3"]


# --- texels and points


class Atlas(NamedTuple):
    """Which face each texel of one texture shows; the point on the face follows from the coordinates.

    It takes four bytes per texel. Texels are numbered row by row; `texels` and `points` list those that show
    the surface, in that order.
    """

    faces: Int32[Any, "H W"]  # the face that each texel shows, −1 for none
    corners: Float64[Any, "F 3 2"]  # corners of all UV triangles, in texels; integers are centres
    planes: Planes  # barycentrics of all UV triangles

    @property
    def height(self) -> int:
        return self.faces.shape[0]

    @property
    def width(self) -> int:
        return self.faces.shape[1]

    @property
    def covered(self) -> Bool[Any, "H W"]:
        return self.faces >= 0

    @property
    def texels(self) -> Int[Any, "P"]:
        return np.flatnonzero(self.covered)

    @property
    def points(self) -> SurfacePoints:
        """The point that each texel shows. It takes 32 bytes per texel: for large atlases use `points_at`."""
        texels = self.texels
        points = SurfacePoints(np.empty(len(texels), np.int64), np.empty((len(texels), 3)))
        for part in chunks(len(texels), CHUNK):
            points.faces[part], points.barycentrics[part] = self.points_at(texels[part])
        return points

    def points_at(self, texels: Int[Any, "N"]) -> SurfacePoints:
        """The point of its face at each texel's centre, or the nearest one if the centre is outside.

        If a texel repeats inside one face, the repeat farthest inside counts.
        """
        faces = self.faces.ravel()[texels].astype(np.int64)
        y, x = np.divmod(texels, self.width)
        repeats = self._repeats(faces, x, y)
        x, y = x + repeats[0][0] * self.width, y + repeats[0][1] * self.height
        barycentrics = self.planes(faces, x, y)
        for right, down in repeats[1:]:
            other = self.planes(faces, x + right * self.width, y + down * self.height)
            better = other.min(0) > barycentrics.min(0)
            barycentrics[:, better] = other[:, better]
        outside = np.flatnonzero(barycentrics.min(0) < 0)  # also where there is no area
        if len(outside):
            places = np.stack([x[outside], y[outside]], 1).astype(np.float64)
            barycentrics[:, outside] = _nearest_on_edges(self.corners[faces[outside]], places).T
        return SurfacePoints(faces, np.ascontiguousarray(barycentrics.T))

    def _repeats(self, faces: Int[Any, "N"], x: Int[Any, "N"], y: Int[Any, "N"]) -> list[tuple[Any, Any]]:
        """By how many widths and heights to move a texel to the middle of its face, and from there to the
        other places where the face may repeat it."""
        if self.corners.min(initial=0) > -1 and (self.corners.max((0, 1)) < [self.width, self.height]).all():
            return [(0, 0)]
        size = np.array([self.width, self.height])
        low, high = (bound(self.corners, 1) / size for bound in (np.min, np.max))
        right, down = np.round((low + high)[faces].T / 2 - [x / self.width, y / self.height]).astype(np.int64)
        reach = np.ceil(np.round((high - low)[faces].max(0) / 2 - 0.5, 6)).astype(int)
        return [(right, down), *(tuple(np.array(n) - reach) for n in np.ndindex(*(2 * reach + 1)))]


def _nearest_on_edges(corners: Float64[Any, "N 3 2"], places: Float64[Any, "N 2"]) -> Float64[Any, "N 3"]:
    """The barycentrics of the point on the outline of each triangle that is nearest to its place."""
    nearest, barycentrics = np.full(len(places), np.inf), np.zeros((len(places), 3))
    for k, after in ((0, 1), (1, 2), (2, 0)):
        edges, offsets = corners[:, after] - corners[:, k], places - corners[:, k]
        along = np.clip(dot(offsets, edges) / np.maximum(dot(edges, edges), np.finfo(float).tiny), 0, 1)
        squares = np.square(offsets - along[:, None] * edges).sum(1)
        nearer = squares < nearest
        nearest[nearer] = squares[nearer]
        barycentrics[nearer] = 0
        barycentrics[nearer, k], barycentrics[nearer, after] = 1 - along[nearer], along[nearer]
    return barycentrics


def atlas_texels(
    mesh: TexturedMesh, texture_index: int, height: int, width: int, slot: Slot = "base_color"
) -> Atlas:
    """Texels whose centres lie in the UV triangles of one texture, at any resolution.

    UVs outside [0, 1] wrap. A texel that several faces claim (a shared edge, a repeated tile) goes to the
    first of them. A face too small to contain a centre takes the free texels that it touches.
    Raises ValueError for a face that spans more than `MOST_REPEATS` repeats.
    """
    layer = mesh.maps[slot]
    corners = layer.corner_uvs * [width, height] - 0.5
    chosen = np.flatnonzero(layer.face_images == texture_index)[::-1]  # the last write wins: the first face
    _check_repeats(layer, chosen)
    faces, met = np.full(height * width, -1, np.int32), np.zeros(len(chosen), bool)
    for pixels in pixels_inside(corners[chosen]):
        faces[pixels.rows % height * width + pixels.columns % width] = chosen[pixels.triangles]
        met[pixels.triangles] = True
    free, small = faces < 0, chosen[~met]
    for hits, columns, rows in _outlines(corners[small]):
        texels = rows % height * width + columns % width
        claimed = free[texels]
        faces[texels[claimed]] = small[hits[claimed]]
    return Atlas(faces.reshape(height, width), corners, barycentric_planes(corners))


def check_repeats(mesh: TexturedMesh) -> None:
    """Raises ValueError for a face that spans more than `MOST_REPEATS` repeats: it cannot be painted."""
    for layer in mesh.maps.values():
        _check_repeats(layer, np.arange(len(mesh.faces)) if layer.images else np.zeros(0, np.int64))


def _check_repeats(layer: Layer, chosen: Int[Any, "N"]) -> None:
    repeats = np.ptp(layer.corner_uvs[chosen], axis=1)
    if repeats.max(initial=0) > MOST_REPEATS:
        face = chosen[repeats.max(1).argmax()]
        raise ValueError(
            f"face {face} spans {counted(repeats.max())} repeats of texture {layer.face_images[face]}, but "
            f"at most {MOST_REPEATS} can be painted; unwrap the mesh again"
        )


def _outlines(corners: Float64[Any, "F 3 2"]) -> Iterator[Pixels]:
    """The pixels that the edges of triangles pass through, within half a pixel, in chunks of edges."""
    corners = corners + 1e-6 * (corners.mean(1, keepdims=True) - corners)  # off the borders of pixels
    edges = np.roll(corners, -1, axis=1) - corners
    steps = 1 + np.ceil(2 * np.linalg.norm(edges, axis=2)).astype(np.int64).ravel()
    starts, edges = corners.reshape(-1, 2), edges.reshape(-1, 2)
    for sides, number in expand(steps):
        places = starts[sides] + edges[sides] * (number / np.maximum(steps[sides] - 1, 1))[:, None]
        columns, rows = np.round(places).astype(np.int64).T
        yield Pixels(sides // 3, columns, rows)


# --- gutters and paint


def fill_gutter(image: Picture, covered: Bool[Any, "H W"], reach: float = np.inf) -> Picture:
    """Give uncovered texels the colour of the nearest covered texel, also across the repeating border.

    Texels farther than `reach` from a covered one keep their colour: other meshes may share the image. A
    bilinear look-up at the rim of a chart reads half a texel beyond it; in a mip level, half of one of its
    larger texels. An image without covered texels is returned unchanged.
    """
    filled = image.copy()
    if covered.all() or not covered.any():
        return filled
    margins = [(min(WRAP, size),) * 2 for size in covered.shape]
    padded = np.pad(~covered, margins, mode="wrap")
    nearest: Any = distance_transform_edt(padded, return_distances=False, return_indices=True)
    (top, _), (left, _) = margins
    height, width = covered.shape
    for row in range(height):
        gutter = np.flatnonzero(~covered[row])
        rows, columns = nearest[:, row + top, gutter + left]
        near = (rows - row - top) ** 2 + (columns - gutter - left) ** 2 <= reach**2
        rows, columns, gutter = rows[near], columns[near], gutter[near]
        filled[row, gutter] = image[(rows - top) % height, (columns - left) % width]
    return filled


def with_filled_gutters(mesh: TexturedMesh) -> TexturedMesh:
    """The mesh with the space between the charts of all its images filled from the nearest chart."""
    for slot, layer in mesh.maps.items():
        images = (
            fill_gutter(image, atlas_texels(mesh, index, *image.shape[:2], slot=slot).covered)
            for index, image in enumerate(layer.images)
        )
        mesh = mesh.with_layer(slot, images=tuple(images))
    return mesh


def paint(atlas: Atlas, colors: Float32[Any, "P 3"], dtype: DTypeLike = np.uint8) -> Picture:
    """An image with these colours, clipped to [0, 1], at the atlas' texels, and filled gutters."""
    image = np.zeros((atlas.height, atlas.width, 3), dtype)
    image[atlas.covered] = quantized(colors, dtype)
    return fill_gutter(image, atlas.covered)


# --- areas


def uv_areas(mesh: TexturedMesh, slot: Slot = "base_color") -> Float64[Any, "F"]:
    """The area of each face on its texture, negative if the texture is mirrored; v runs down."""
    u, v = np.moveaxis(mesh.maps[slot].corner_uvs, -1, 0)
    return ((u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0]) - (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0])) / 2
