"""Points on a surface: their positions, the colours there, the closest points on another triangulation.

A point is a face and three barycentrics (`SurfacePoints`). A zero-area face has the zero normal. Large work
goes in chunks: memory is bounded by the result, not by the mesh.
"""

from typing import Any

import igl
import numpy as np
from jaxtyping import Float32, Float64, Int, UInt

from flx.geometry.arrays import Rng, area_normals, chunks, dot, face_areas
from flx.geometry.raster import CHUNK
from flx.types import Faces, Slot, SurfacePoints, TexturedMesh, Triangulation, Vertices

Surface = TexturedMesh | Triangulation
Places = Float64[Any, "P 3"]  # in space, in the units of the vertices
Colors = Float32[Any, "P 3"]


def positions(vertices: Vertices, faces: Faces, points: SurfacePoints) -> Places:
    """The positions of points of a surface in space."""
    return np.einsum("pkx,pk->px", vertices[faces[points.faces]], points.barycentrics)


def face_normals(vertices: Vertices, faces: Faces) -> Float64[Any, "F 3"]:
    """Unit normals, outward for counter-clockwise faces; zero where a face has no area."""
    normals = area_normals(vertices, faces)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1.0)


def texture_colors(image: UInt[Any, "H W 3"], uvs: Float64[Any, "P 2"]) -> Colors:
    """Bilinear colours of a repeating texture at any real (u, v)."""
    height, width = image.shape[:2]
    texels = image.reshape(-1, 3)
    colors = np.empty((len(uvs), 3), np.float32)
    for part in chunks(len(uvs), CHUNK):
        x, y = (uvs[part] * [width, height] - 0.5).T
        left, top = np.floor(x), np.floor(y)
        right_share, low_share = (x - left).astype(np.float32), (y - top).astype(np.float32)
        left, top = left.astype(np.int64) % width, top.astype(np.int64) % height
        columns, rows = (left, (left + 1) % width), (top * width, (top + 1) % height * width)
        chunk = np.zeros((len(x), 3), np.float32)
        for row, vertical in zip(rows, (1 - low_share, low_share), strict=True):
            for column, horizontal in zip(columns, (1 - right_share, right_share), strict=True):
                chunk += texels.take(row + column, axis=0) * (vertical * horizontal)[:, None]
        colors[part] = chunk / np.float32(np.iinfo(image.dtype).max)
    return colors


def surface_colors(mesh: TexturedMesh, points: SurfacePoints, slot: Slot = "base_color") -> Colors:
    """The colours of points, or the values of another slot there, in [0, 1] as they are stored.

    Texture coordinates are those of the point's own face, so a UV seam never mixes two charts.
    """
    layer = mesh.maps[slot]
    if not layer.images:
        blend = np.einsum("pkc,pk->pc", mesh.corner_colors[points.faces], points.barycentrics)
        return blend.astype(np.float32)
    uvs = np.einsum("pkx,pk->px", layer.corner_uvs.take(points.faces, 0), points.barycentrics)
    if len(layer.images) == 1:
        return texture_colors(layer.images[0], uvs)
    shown = layer.face_images[points.faces]
    colors = np.empty((len(uvs), 3), np.float32)
    for index, image in enumerate(layer.images):
        chosen = np.flatnonzero(shown == index)
        colors[chosen] = texture_colors(image, uvs[chosen])
    return colors


def locate(places: Places, normals: Places, vertices: Vertices, faces: Faces) -> SurfacePoints:
    """The points of a triangulation closest to places, on the side that faces as the unit `normals` do.

    On a thin wall the closest face may be on the far side. If its normal opposes the point's, the search is
    repeated among faces that agree. Opposed points are grouped by the nearest of 26 directions; the faces
    searched are close enough to that direction to agree with every point of the group. Without such a face,
    the first hit stays.
    """
    hits = closest_points(places, vertices, faces)
    targets = face_normals(vertices, faces)
    opposed = np.flatnonzero(dot(targets[hits.faces], normals) < 0)
    grid = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], np.float64) - 1
    directions = grid / np.linalg.norm(grid, axis=1, keepdims=True)
    cosines = normals[opposed] @ directions.T
    nearest = cosines.argmax(1)
    for group in np.unique(nearest):
        members = nearest == group
        spread = np.sqrt(np.maximum(1 - cosines[members, group].min() ** 2, 0))
        agreeing, members = np.flatnonzero(targets @ directions[group] > spread), opposed[members]
        if len(agreeing):
            again = closest_points(places[members], vertices, faces[agreeing])
            hits.faces[members], hits.barycentrics[members] = agreeing[again.faces], again.barycentrics
    return hits


def closest_points(places: Places, vertices: Vertices, faces: Faces) -> SurfacePoints:
    """The closest points on a triangulation, whichever way it faces there."""
    _, hits, closest = igl.point_mesh_squared_distance(
        np.ascontiguousarray(places), np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64)
    )
    faces_hit = np.ravel(hits).astype(np.int64)  # libigl returns another 64-bit integer type
    closest, barycentrics = np.asarray(closest).reshape(-1, 3), np.empty((len(places), 3))
    for part in chunks(len(places), CHUNK):
        barycentrics[part] = _barycentrics(closest[part], vertices[faces[faces_hit[part]]])
    return SurfacePoints(faces_hit, barycentrics)


def _barycentrics(points: Places, corners: Float64[Any, "P 3 3"]) -> Float64[Any, "P 3"]:
    """The barycentrics of points, each on a triangle of its own."""
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, ac, ap = b - a, c - a, points - a
    area = np.maximum(dot(ab, ab) * dot(ac, ac) - dot(ab, ac) ** 2, np.finfo(float).tiny)
    second = (dot(ac, ac) * dot(ap, ab) - dot(ab, ac) * dot(ap, ac)) / area
    third = (dot(ab, ab) * dot(ap, ac) - dot(ab, ac) * dot(ap, ab)) / area
    barycentrics = np.clip(np.stack([1 - second - third, second, third], 1), 0, 1)
    return barycentrics / barycentrics.sum(1, keepdims=True)


def ring_points(
    triangulation: Triangulation, samples: int, rng: Rng
) -> tuple[SurfacePoints, Int[Any, "V S"]]:
    """Points uniform by area in each vertex's one-ring, and which corner of its face the vertex is.

    Stratified: sample s lies in the s-th equal share of the ring's faces laid end to end. The points of
    vertex v start at v·samples. Every vertex must have a face.
    """
    vertices, faces = triangulation
    fans = np.argsort(faces.ravel(), kind="stable")  # corners, grouped by their vertex
    ends = np.cumsum(np.bincount(faces.ravel(), minlength=len(vertices)))
    starts = np.concatenate([[0], ends[:-1]])
    laid = np.concatenate([[0.0], np.cumsum(face_areas(vertices, faces)[fans // 3])])
    shares = (np.arange(samples) + rng.random((len(vertices), samples))) / samples
    marks = laid[starts][:, None] + (laid[ends] - laid[starts])[:, None] * shares
    picked = np.searchsorted(laid, marks.ravel(), side="right").reshape(marks.shape) - 1
    picked = fans[np.clip(picked, starts[:, None], ends[:, None] - 1)]
    second, third = rng.random((2, picked.size))
    folded = second + third > 1
    second[folded], third[folded] = 1 - second[folded], 1 - third[folded]
    barycentrics = np.stack([1 - second - third, second, third], 1)
    return SurfacePoints(picked.ravel() // 3, barycentrics), picked % 3


def transfer(points: SurfacePoints, source: Surface, target: Surface) -> SurfacePoints:
    """The closest points of another triangulation that face the same way."""
    normals = face_normals(source.vertices, source.faces)[points.faces]
    places = positions(source.vertices, source.faces, points)
    return locate(places, normals, target.vertices, target.faces)
