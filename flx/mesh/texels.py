"""Between a surface and its textures: colours at points, texels to points, points of one-rings.

Texture coordinates run right and down and repeat; texel (row, column) has its centre at
u = (column + ½)/W, v = (row + ½)/H, so u·W − ½ is a column. Colours are sRGB in [0, 1] as float32, textures
uint8. A point on a surface is a face and three barycentrics (`SurfacePoints`); a zero-area face has no texels
and the zero normal. Large work goes in chunks: memory is bounded by the result, not by the mesh.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import igl
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, UInt8
from scipy.ndimage import distance_transform_edt

from flx.types import SurfacePoints, TexturedMesh, Triangulation

CHUNK = 1 << 16  # points handled at a time: what the cache holds
INSIDE = -1e-9  # least barycentric of a pixel inside: a shared edge leaves no hole
WRAP = 8  # texels by which a gutter looks across the border of a repeating texture


def positions(
    vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], points: SurfacePoints
) -> Float64[Any, "P 3"]:
    """Where points of a surface are in space, in the vertices' units."""
    return np.einsum("pkx,pk->px", vertices[faces[points.faces]], points.barycentrics)


def face_normals(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]) -> Float64[Any, "F 3"]:
    """Unit normals, outward for counter-clockwise faces; zero where a face has no area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1.0)


# --- colours at points


def texture_colors(image: UInt8[Any, "H W 3"], uvs: Float64[Any, "P 2"]) -> Float32[Any, "P 3"]:
    """Bilinear colours of a repeating texture at any real (u, v); v runs down."""
    height, width = image.shape[:2]
    texels = image.reshape(-1, 3)
    colors = np.empty((len(uvs), 3), np.float32)
    for start in range(0, len(uvs), CHUNK):
        pixels = uvs[start : start + CHUNK] * [width, height] - 0.5
        floors = np.floor(pixels)
        right, down = (pixels - floors).astype(np.float32).T
        left, top = floors.astype(np.int64).T
        columns, rows = (left % width, (left + 1) % width), (top % height * width, (top + 1) % height * width)
        chunk = texels[rows[0] + columns[0]] * ((1 - right) * (1 - down))[:, None]
        chunk += texels[rows[0] + columns[1]] * (right * (1 - down))[:, None]
        chunk += texels[rows[1] + columns[0]] * ((1 - right) * down)[:, None]
        chunk += texels[rows[1] + columns[1]] * (right * down)[:, None]
        colors[start : start + CHUNK] = chunk / np.float32(255)
    return colors


def surface_colors(mesh: TexturedMesh, points: SurfacePoints) -> Float32[Any, "P 3"]:
    """The colours of points, from the hit face's own corners: a UV seam never mixes two charts."""
    if not mesh.textures:
        blend = np.einsum("pkc,pk->pc", mesh.corner_colors[points.faces], points.barycentrics)
        return blend.astype(np.float32)
    uvs = np.einsum("pkx,pk->px", mesh.corner_uvs[points.faces], points.barycentrics)
    textures = mesh.face_textures[points.faces]
    colors = np.empty((len(uvs), 3), np.float32)
    for index in np.unique(textures):
        chosen = textures == index
        colors[chosen] = texture_colors(mesh.textures[index], uvs[chosen])
    return colors


# --- pixels inside triangles


class Pixels(NamedTuple):
    """Pixel centres inside triangles. A pixel may come more than once, with different triangles."""

    triangles: Int[Any, "N"]
    columns: Int[Any, "N"]
    rows: Int[Any, "N"]
    barycentrics: Float64[Any, "N 3"]  # ≥ 0, sums to 1


def pixels_inside(corners: Float64[Any, "F 3 2"]) -> Iterator[Pixels]:
    """Scan-convert triangles given in pixels (x right, y down; integers are centres), a chunk at a time.

    Each row of a triangle is cut to the columns where all three barycentrics are ≥ 0, so long thin triangles
    cost what they cover, not their bounding boxes. Triangles come in ascending order; those of no area never.
    """
    origins, edges = corners[:, 0], corners[:, 1:] - corners[:, :1]
    areas = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    first = np.ceil(corners[:, :, 1].min(1)).astype(np.int64)
    last = np.floor(corners[:, :, 1].max(1)).astype(np.int64)
    heights = np.where(np.abs(areas) > 1e-12, np.maximum(last - first + 1, 0), 0)
    slopes = np.zeros((len(corners), 2, 2))  # of barycentrics 1 and 2 along x and y
    np.divide(
        np.stack([edges[:, 1, 1], -edges[:, 1, 0], -edges[:, 0, 1], edges[:, 0, 0]], 1).reshape(-1, 2, 2),
        areas[:, None, None],
        out=slopes,
        where=(heights > 0)[:, None, None],
    )
    slopes = np.concatenate([-slopes.sum(1, keepdims=True), slopes], 1)

    for triangles, steps in _expand(heights):
        rows = first[triangles] + steps
        along, across = slopes[triangles, :, 0], slopes[triangles, :, 1]
        at_zero = across * (rows - origins[triangles, 1])[:, None] - along * origins[triangles, :1]
        at_zero[:, 0] += 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = (INSIDE - at_zero) / along
        left = np.ceil(np.where(along > 0, crossings, -np.inf).max(1))
        right = np.floor(np.where(along < 0, crossings, np.inf).min(1))
        outside = ((along == 0) & (at_zero < INSIDE)).any(1)
        widths = np.where(outside, 0, np.maximum(right - left + 1, 0)).astype(np.int64)
        for spans, columns in _expand(widths):
            columns = columns + left[spans].astype(np.int64)
            barycentrics = np.maximum(at_zero[spans] + along[spans] * columns[:, None], 0.0)
            barycentrics /= np.einsum("pk->p", barycentrics)[:, None]  # sum(1) takes 5 times as long
            yield Pixels(triangles[spans], columns, rows[spans], barycentrics)


def _expand(counts: Int[Any, "N"]) -> Iterator[tuple[Int[Any, "M"], Int[Any, "M"]]]:
    """Item i repeated counts[i] times, with 0, 1, 2 … beside it, in chunks that hold at least one item."""
    ends = np.cumsum(counts)
    start = 0
    while start < len(counts):
        done = ends[start] - counts[start]
        stop = max(int(np.searchsorted(ends, done + CHUNK, side="right")), start + 1)
        items = np.repeat(np.arange(start, stop), counts[start:stop])
        if len(items):
            yield items, np.arange(len(items)) - (ends[items] - counts[items] - done)
        start = stop


# --- texels and points


class Atlas(NamedTuple):
    """The texels of one texture that show the surface, each with its point on the original mesh."""

    rows: Int[Any, "P"]
    columns: Int[Any, "P"]
    points: SurfacePoints
    height: int
    width: int


def atlas_texels(mesh: TexturedMesh, texture_index: int, height: int, width: int) -> Atlas:
    """Texels whose centres lie in the UV triangles of one texture; any size, whatever the texture's own.

    UVs outside [0, 1] wrap. A texel that several faces claim (a shared edge, a repeated tile) comes once,
    with the first of them.
    """
    chosen = np.flatnonzero(mesh.face_textures == texture_index)
    owners = np.full(height * width, -1, np.int64)  # the running number of the hit that took the texel
    found: list[Pixels] = []
    count = 0
    for pixels in pixels_inside(mesh.corner_uvs[chosen] * [width, height] - 0.5):
        columns, rows = pixels.columns % width, pixels.rows % height
        texels = rows * width + columns
        free = np.flatnonzero(owners[texels] < 0)
        numbers = count + np.arange(len(free))
        owners[texels[free][::-1]] = numbers[::-1]  # the last write stays: the first face
        free = free[owners[texels[free]] == numbers]
        owners[texels[free]] = count  # any number that is taken
        faces = chosen[pixels.triangles[free]]
        found.append(Pixels(faces, columns[free], rows[free], pixels.barycentrics[free]))
        count += len(numbers)
    if not found:
        none = np.zeros(0, np.int64)
        return Atlas(none, none, SurfacePoints(none, np.zeros((0, 3))), height, width)
    faces, columns, rows, barycentrics = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Atlas(rows, columns, SurfacePoints(faces, barycentrics), height, width)


def fill_gutter(image: UInt8[Any, "H W 3"], covered: Bool[Any, "H W"]) -> UInt8[Any, "H W 3"]:
    """Every uncovered texel takes its nearest covered texel's colour, also across the repeating border.

    A bilinear look-up at the rim of a chart reads half a texel beyond it. An image without a covered texel
    comes back as it is.
    """
    if covered.all() or not covered.any():
        return image.copy()
    margins = [(min(WRAP, size),) * 2 for size in covered.shape]
    padded = np.pad(covered, margins, mode="wrap")
    nearest = distance_transform_edt(~padded, return_distances=False, return_indices=True)
    inner = tuple(slice(low, size + low) for (low, _), size in zip(margins, covered.shape, strict=True))
    rows, columns = (
        (nearest[axis][inner] - margins[axis][0]) % covered.shape[axis]  # pyright: ignore[reportOptionalSubscript]
        for axis in range(2)
    )
    return image[rows, columns]


def with_filled_gutters(mesh: TexturedMesh) -> TexturedMesh:
    """The mesh with what lies between the charts of its textures replaced by the nearest chart's colour."""
    textures = []
    for index, image in enumerate(mesh.textures):
        atlas = atlas_texels(mesh, index, image.shape[0], image.shape[1])
        covered = np.zeros(image.shape[:2], bool)
        covered[atlas.rows, atlas.columns] = True
        textures.append(fill_gutter(image, covered))
    return mesh._replace(textures=tuple(textures))


def paint(
    atlas: Atlas, colors: Float32[Any, "P 3"], background: UInt8[Any, "H W 3"] | None = None
) -> UInt8[Any, "H W 3"]:
    """The texture with these colours at the atlas' texels and filled gutters; colours are clipped to [0, 1].

    `background` (default black), of the atlas' size, is what a texture that no face uses keeps.
    """
    image = np.zeros((atlas.height, atlas.width, 3), np.uint8) if background is None else background.copy()
    if image.shape[:2] != (atlas.height, atlas.width):
        raise ValueError(
            f"background has {image.shape[1]}x{image.shape[0]} texels but the atlas has "
            f"{atlas.width}x{atlas.height}; resize it, or leave it out"
        )
    covered = np.zeros(image.shape[:2], bool)
    covered[atlas.rows, atlas.columns] = True
    image[atlas.rows, atlas.columns] = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    return fill_gutter(image, covered)


# --- points of another surface, points of one-rings


def locate(
    points: Float64[Any, "P 3"],
    normals: Float64[Any, "P 3"] | None,
    vertices: Float64[Any, "V 3"],
    faces: Int[Any, "F 3"],
) -> SurfacePoints:
    """The closest points on a triangulation; with unit `normals`, on the side that faces as they do.

    On a thin wall the closest face may be the far side's. Where its normal opposes the query's, the query is
    asked again among faces that agree. Opposed queries are grouped by the nearest of 26 directions; the faces
    asked lie near enough to the group's direction to agree with every query in it. A query without any such
    face keeps its first answer.
    """
    hits = _closest(points, vertices, faces)
    if normals is None:
        return hits
    targets = face_normals(vertices, faces)
    opposed = np.flatnonzero(np.einsum("px,px->p", targets[hits.faces], normals) < 0)
    grid = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], np.float64) - 1
    directions = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    cosines = normals[opposed] @ directions.T
    nearest = cosines.argmax(1)
    for group in np.unique(nearest):
        members = nearest == group
        spread = np.sqrt(np.maximum(1 - cosines[members, group].min() ** 2, 0))
        agreeing = np.flatnonzero(targets @ directions[group] > spread)
        if len(agreeing) == 0:
            continue
        again = _closest(points[opposed[members]], vertices, faces[agreeing])
        hits.faces[opposed[members]] = agreeing[again.faces]
        hits.barycentrics[opposed[members]] = again.barycentrics
    return hits


def _closest(
    points: Float64[Any, "P 3"], vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"]
) -> SurfacePoints:
    _, hits, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points), np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    )
    faces_hit = np.empty(len(points), np.int64)  # libigl's integer is another of 64 bits
    faces_hit[:] = np.ravel(hits)
    a, b, c = (vertices[faces[faces_hit, k]] for k in range(3))
    ab, ac, ap = b - a, c - a, np.asarray(closest).reshape(-1, 3) - a
    dot = lambda x, y: np.einsum("px,px->p", x, y)  # noqa: E731
    area = np.maximum(dot(ab, ab) * dot(ac, ac) - dot(ab, ac) ** 2, np.finfo(float).tiny)
    second = (dot(ac, ac) * dot(ap, ab) - dot(ab, ac) * dot(ap, ac)) / area
    third = (dot(ab, ab) * dot(ap, ac) - dot(ab, ac) * dot(ap, ab)) / area
    barycentrics = np.clip(np.stack([1 - second - third, second, third], 1), 0, 1)
    return SurfacePoints(faces_hit, barycentrics / barycentrics.sum(1, keepdims=True))


def ring_points(
    triangulation: Triangulation, samples: int, rng: np.random.Generator
) -> tuple[SurfacePoints, Int[Any, "V S"]]:
    """Points uniform by area in each vertex's one-ring, and which corner of its face the vertex is.

    Stratified: sample s lies in the s-th equal share of the ring's faces laid end to end. The points are
    flattened, those of vertex v from v·samples on. Every vertex must have a face.
    """
    vertices, faces = triangulation
    fans = np.argsort(faces.ravel(), kind="stable")  # corners, grouped by their vertex
    ends = np.cumsum(np.bincount(faces.ravel(), minlength=len(vertices)))
    starts = np.concatenate([[0], ends[:-1]])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    laid = np.concatenate([[0.0], np.cumsum(areas[fans // 3])])
    shares = (np.arange(samples) + rng.random((len(vertices), samples))) / samples
    marks = laid[starts][:, None] + (laid[ends] - laid[starts])[:, None] * shares
    picked = np.searchsorted(laid, marks.ravel(), side="right").reshape(marks.shape) - 1
    picked = fans[np.clip(picked, starts[:, None], ends[:, None] - 1)]
    second, third = rng.random((2, picked.size))
    folded = second + third > 1
    second[folded], third[folded] = 1 - second[folded], 1 - third[folded]
    barycentrics = np.stack([1 - second - third, second, third], 1)
    return SurfacePoints(picked.ravel() // 3, barycentrics), picked % 3
