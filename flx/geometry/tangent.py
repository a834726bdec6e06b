"""Intrinsic tangent geometry: frames, log maps, parallel transport, masses.

Only edge lengths matter: a sheet folded along its edges has the geometry of the flat one. A tangent vector
at p is a complex number in p's frame, whose x axis is the first edge of p's ordered one-ring; angles run
counter-clockwise about the outward normal. Corner angles are summed in ring order and rescaled so that they
add up to 2π at interior vertices. At the boundary they are not rescaled, so flat meshes stay flat.

Triangulations are manifold and oriented, open or closed, with any number of components. Rings differ in
size; they are padded with -1 to the largest. Everything is float64.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex128, Float64, Int

from flx.arguments import briefly
from flx.geometry.arrays import distinct_rows, face_areas, mark
from flx.types import Triangulation

Corners = Int[Any, "C"]


class TangentFrames(NamedTuple):
    """The frame of every vertex and its neighbours in that frame. N is the largest number of neighbours."""

    neighbors: Int[Any, "V N"]  # counter-clockwise, from one boundary edge to the other; spare: -1
    reverse: Int[Any, "V N"]  # the index of p among the neighbours of its k-th neighbour; spare: k
    directions: Complex128[Any, "V N"]  # e^{iθ_p(q)}; spare: 1
    lengths: Float64[Any, "V N"]  # |pq| in the units of the mesh; spare: 0
    corner_angles: Float64[Any, "F 3"]  # flat, radians
    corner_starts: Float64[Any, "F 3"]  # θ of the edge that leaves corner i towards corner i + 1
    scales: Float64[Any, "V"]  # 2π / total angle at interior vertices, 1 at the boundary
    boundary: Bool[Any, "V"]
    masses: Float64[Any, "V"]  # `vertex_masses`
    radius: float  # `mean_vertex_radius`


def check_triangulation(triangulation: Triangulation) -> None:
    """Raises ValueError, naming the row, for arrays that are not the vertices and faces of a surface.

    These are: lists, other shapes, positions that are not finite, indices of vertices that are not there,
    faces with a corner twice, a surface without area, and triangles that share positions but no vertices.
    """
    for name, shape, kinds, words in (
        ("vertices", "[V, 3]", "f", "real numbers"),
        ("faces", "[F, 3]", "iu", "indices of vertices"),
    ):
        array = getattr(triangulation, name, None)
        if not isinstance(array, np.ndarray):
            given = briefly(triangulation if array is None else array)
            what = "triangulation" if array is None else name
            raise ValueError(f"{what} is {given}; give a Triangulation of NumPy arrays")
        if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in kinds:
            raise ValueError(f"{name} are {array.dtype}, {list(array.shape)}; give {words}, {shape}")
    vertices, faces = triangulation
    if (wrong := ~np.isfinite(vertices).all(1)).any():
        row = int(wrong.argmax())
        raise ValueError(f"vertices[{row}] is {vertices[row].tolist()}; give finite numbers")
    if not len(faces):
        raise ValueError(f"{len(vertices)} vertices have no faces; give at least one triangle")
    if (wrong := ((faces < 0) | (faces >= len(vertices))).any(1)).any():
        row, count = int(wrong.argmax()), len(vertices)
        raise ValueError(f"faces[{row}] is {faces[row].tolist()}, but there are {count} vertices, from 0")
    if (wrong := (faces == np.roll(faces, 1, axis=1)).any(1)).any():
        row = int(wrong.argmax())
        raise ValueError(f"faces[{row}] is {faces[row].tolist()}: a corner twice; leave this face out")
    if not face_areas(vertices, faces).any():
        raise ValueError("no face has an area; scale the mesh up, or export it again")
    if len(faces) > 1 and len(vertices) >= 3 * len(faces):
        places = len(distinct_rows(vertices[faces.ravel()])[0])
        if 2 * places < 3 * len(faces):
            raise ValueError(
                f"{len(faces)} triangles meet at {places} places, but no two share a vertex; weld them "
                "first, as flx.from_arrays does"
            )


def vertex_masses(triangulation: Triangulation) -> Float64[Any, "V"]:
    """A third of the area of the faces around each vertex, in squared units of the mesh."""
    thirds = np.repeat(face_areas(*triangulation) / 3, 3)
    return np.bincount(triangulation.faces.ravel(), thirds, minlength=len(triangulation.vertices))


def mean_vertex_radius(triangulation: Triangulation) -> float:
    """r̄ = √(A / (π V)), the radius of a disc of the mean area per vertex: our unit of length."""
    return float(np.sqrt(face_areas(*triangulation).sum() / (np.pi * len(triangulation.vertices))))


def tangent_frames(triangulation: Triangulation) -> TangentFrames:
    """Order the one-rings and sum the rescaled corner angles along them.

    A corner is c = 3 face + i, at vertex faces[face, i]. Counter-clockwise around its vertex, the next corner
    is the one whose outgoing edge is the reverse of this one's incoming edge. All vertices advance together.

    Raises ValueError where arrays cannot be used (`check_triangulation`), where two faces run along an edge
    in the same direction, or a vertex joins two fans.
    """
    check_triangulation(triangulation)
    vertices, faces = triangulation.vertices, triangulation.faces.astype(np.int64)
    count = len(vertices)
    at, to, back = faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    following = _following_corners(at, to, back, count)
    corner_angles = _corner_angles(triangulation)
    angles = corner_angles.ravel()

    first = np.full(count, -1)
    first[at[::-1]] = np.arange(len(at))[::-1]  # interior vertices start at their first corner
    opening = np.flatnonzero(~mark(len(at), following[following >= 0]))
    first[at[opening]] = opening
    boundary = ~mark(count, at) | mark(count, at[opening])  # a vertex without faces counts as boundary

    degrees = np.bincount(at, minlength=count)
    width = int((degrees + boundary).max(initial=0))
    neighbors = np.full((count, width), -1)
    theta, starts = np.zeros((count, width)), np.zeros(len(at))
    total, visited = np.zeros(count), np.zeros(count, np.int64)
    active = np.flatnonzero(first >= 0)
    corner = first[active]
    for k in range(width):
        if not len(active):
            break
        neighbors[active, k] = to[corner]
        theta[active, k] = starts[corner] = total[active]
        total[active] += angles[corner]
        visited[active] += 1
        after = following[corner]
        last = active[after < 0]
        if len(last):  # the second boundary edge
            neighbors[last, k + 1] = back[corner[after < 0]]
            theta[last, k + 1] = total[last]
        onward = (after >= 0) & (after != first[active])
        active, corner = active[onward], after[onward]
    if (visited != degrees).any():
        vertex = int(np.flatnonzero(visited != degrees)[0])
        raise ValueError(f"vertex {vertex} joins several fans of faces; split it before measuring tangents")

    scales = np.ones(count)
    scales[~boundary] = 2 * np.pi / total[~boundary]
    spare = neighbors < 0
    lengths = np.linalg.norm(vertices[neighbors] - vertices[:, None], axis=2)
    return TangentFrames(
        neighbors=neighbors,
        reverse=_reverse_places(neighbors),
        directions=np.exp(1j * theta * scales[:, None]),
        lengths=np.where(spare, 0.0, lengths),
        corner_angles=corner_angles,
        corner_starts=(starts * scales[at]).reshape(-1, 3),
        scales=scales,
        boundary=boundary,
        masses=vertex_masses(triangulation),
        radius=mean_vertex_radius(triangulation),
    )


def transports(frames: TangentFrames) -> Complex128[Any, "V N"]:
    """P_{p←q} = e^{i(θ_p(q) + π − θ_q(p))}: the edge pq has the same direction in both frames. Spare: 1."""
    seen_from_neighbor = frames.directions[frames.neighbors, frames.reverse]
    return np.where(frames.neighbors < 0, 1.0, -frames.directions * seen_from_neighbor.conj())


def corner_logs(
    frames: TangentFrames,
    triangulation: Triangulation,
    faces: Int[Any, "P"],
    barycentrics: Float64[Any, "P 3"],
) -> Complex128[Any, "P 3"]:
    """The log of each point at the three corners of its face, in mean vertex radii.

    Distances are flat inside the face. The flat angle from the edge i → i+1 is rescaled like the corner
    angles of the vertex, so that logs agree along the edges between faces.
    """
    corners = triangulation.faces[faces]
    points = triangulation.vertices[corners]
    to_next = np.linalg.norm(np.roll(points, -1, axis=1) - points, axis=2)
    flat = np.roll(barycentrics, -1, axis=1) * to_next  # corner i has edge i → i+1 along its x axis
    flat = flat + np.roll(barycentrics * to_next, -2, axis=1) * np.exp(1j * frames.corner_angles[faces])
    angle = frames.corner_starts[faces] + frames.scales[corners] * np.angle(flat)
    return np.abs(flat) * np.exp(1j * angle) / frames.radius


def _corner_angles(triangulation: Triangulation) -> Float64[Any, "F 3"]:
    """Angles from sine and cosine: in slivers, the arc cosine of edge lengths loses half of the digits."""
    points = triangulation.vertices[triangulation.faces]
    out, back = np.roll(points, -1, axis=1) - points, np.roll(points, -2, axis=1) - points
    return np.arctan2(np.linalg.norm(np.cross(out, back), axis=2), (out * back).sum(axis=2))


def _following_corners(at: Corners, to: Corners, back: Corners, count: int) -> Corners:
    """The next corner counter-clockwise around the same vertex; -1 where the boundary ends the fan."""
    if not len(at):
        return at
    leaving, arriving = at * count + to, at * count + back
    order = np.argsort(leaving, kind="stable")
    ordered = leaving[order]
    if (twice := np.flatnonzero(ordered[1:] == ordered[:-1])).size:
        p, q = divmod(int(ordered[twice[0]]), count)
        raise ValueError(f"edge {p} → {q} has two faces on one side; make the mesh manifold and oriented")
    place = np.minimum(np.searchsorted(ordered, arriving), len(ordered) - 1)
    return np.where(ordered[place] == arriving, order[place], -1)


def _reverse_places(neighbors: Int[Any, "V N"]) -> Int[Any, "V N"]:
    """`TangentFrames.reverse`: the i-th edge sorted by (p, q) is the reverse of the i-th sorted by (q, p)."""
    count, width = neighbors.shape
    p, k = np.nonzero(neighbors >= 0)
    q = neighbors[p, k]
    forth, back = np.argsort(p * count + q), np.argsort(q * count + p)
    reverse = np.tile(np.arange(width), (count, 1))
    reverse[p[forth], k[forth]] = k[back]
    return reverse
