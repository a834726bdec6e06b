"""Random triangulations: of a given surface, to an exact vertex count, and of a planar rectangle.

A field network must not learn the mesh it lives on, so it sees one surface in many *independent*
triangulations. Edge-length remeshers keep the input's vertices when the densities are alike (95 % of them);
here random collapses to 1.4 times the wanted edge length come first, and the copies share about as many
points as chance would have it. After that: split, collapse, flip, smooth, project (Botsch & Kobbelt 2004,
"A remeshing approach to multiresolution modeling").
"""

from typing import Any

import numpy as np
from jaxtyping import Float64, Int

from flx.geometry.arrays import area_normals, length_of
from flx.geometry.remesh.finishing import finish
from flx.geometry.remesh.operators import ASK_ALL, collapse, flip, split
from flx.geometry.remesh.smoothing import Surface, smooth
from flx.geometry.topology import edge_lengths, invariants, mark, topology
from flx.types import Triangulation

COARSENING = 1.4  # edge length of the random coarse mesh, in wanted edge lengths; at 1.0 copies share 74 %
ROUNDS = 2
FEW = 0.015  # of the vertices: fewer collapses at once are not worth another look
LONGEST, SHORTEST = 4 / 3, 0.8  # of the wanted edge length (Botsch & Kobbelt)


def remesh(vertices: Float64[Any, "V 3"], faces: Int[Any, "F 3"], count: int, seed: int) -> Triangulation:
    """An isotropic triangulation of a surface with exactly `count` vertices, another one for every seed.

    The input is a manifold, consistently oriented mesh, open or closed, of any density. Components, Euler
    characteristic and boundary loops are kept; so are boundaries and creases (faces that bend more than 60°
    along at least four edges), those of walls thinner than a third of an edge as one edge. Same seed, same
    machine: same bits. About 3 CPU seconds for 30,000 vertices.

    Raises ValueError where the input is not such a mesh, or has no triangulation that small.
    """
    shape = invariants(vertices, faces)
    if count < 4:
        raise ValueError(f"no surface has a triangulation of {count} vertices; ask for more vertices")
    area = length_of(area_normals(vertices, faces)).sum() / 2
    length = float(np.sqrt(2 * area / (np.sqrt(3) * count)))  # of the edges, were all faces equilateral
    rng = np.random.default_rng(seed)
    mesh = Triangulation(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64))
    surface = Surface(*mesh, length)
    mesh = _coarsen(mesh, surface, length, rng)
    for _ in range(ROUNDS):
        mesh = _split_long(mesh, LONGEST * length, rng)
        mesh = _collapse_short(mesh, length, rng)
        mesh = smooth(flip(mesh, rng, delaunay=False, passes=4), surface, passes=2)
        mesh = _settle(mesh, count, length, rng)
        mesh = smooth(flip(mesh, rng, delaunay=False, passes=4), surface, passes=1)
    mesh = finish(flip(mesh, rng, delaunay=True, passes=8), surface, rng)
    if len(mesh.vertices) != count or invariants(*mesh) != shape:
        raise ValueError(
            f"remeshing {len(vertices)} vertices ({shape}) to {count} ended at {len(mesh.vertices)} "
            f"({invariants(*mesh)}); ask for more vertices"
        )
    return mesh


def _coarsen(mesh, surface, length, rng):
    """Random collapses to a coarse mesh: what makes the copies independent of the input and each other."""
    mesh = _split_long(mesh, LONGEST * COARSENING * length, rng)
    mesh = smooth(mesh, surface, passes=1)
    mesh = _collapse_short(mesh, COARSENING * length, rng)
    return smooth(flip(mesh, rng, delaunay=False, passes=4), surface, passes=2)


def _split_long(mesh, longest, rng):
    """Split until no edge is longer than `longest`."""
    while True:
        topo = topology(mesh.faces, len(mesh.vertices))
        long = edge_lengths(mesh.vertices, topo) > longest
        if not long.any():
            return mesh
        mesh = split(mesh, topo, long, rng)


def _collapse_short(mesh, length, rng):
    """Collapse until few edges are shorter than 0.8 `length`."""
    refused = ASK_ALL
    while True:
        mesh, done, refused = collapse(mesh, SHORTEST * length, LONGEST * length, rng, refused=refused)
        if done < FEW * len(mesh.vertices):
            return mesh


def _settle(mesh, count, length, rng):
    """Bring the mesh to `count` vertices: collapse its shortest edges, less and less choosy, or split."""
    for shortest, longest, bend in ((1.3, 2.0, 0.3), (2.0, 3.0, 0.1), (np.inf, np.inf, -1.0)):
        done, refused = 1, ASK_ALL
        while done and len(mesh.vertices) > count:
            surplus = len(mesh.vertices) - count
            mesh, done, refused = collapse(
                mesh, shortest * length, longest * length, rng, surplus, bend, refused
            )
    while len(mesh.vertices) < count:
        mesh = _split_longest(mesh, count - len(mesh.vertices), rng)
    return mesh


def _split_longest(mesh, most, rng):
    """Split up to `most` of the edges that are the longest of both their faces, the longest first."""
    topo = topology(mesh.faces, len(mesh.vertices))
    lengths = edge_lengths(mesh.vertices, topo)
    longest = np.zeros(len(lengths))
    np.maximum.at(longest, topo.face_edges, lengths[topo.face_edges].max(1)[:, None])
    ids = np.flatnonzero(lengths >= longest)
    ids = ids[np.argsort(-lengths[ids], kind="stable")[:most]]
    return split(mesh, topo, mark(len(lengths), ids), rng)
