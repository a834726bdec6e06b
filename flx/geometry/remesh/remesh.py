"""Random isotropic remeshing of a surface to an exact vertex count.

A field network must not learn the mesh it lives on, so it sees one surface in many *independent*
triangulations. Edge-length remeshers keep most vertices of an input of similar density (95 %). Here random
collapses to 1.4 times the wanted edge length come first, so copies share no more points than by chance. Then
follow splits, collapses, flips, smoothing and projection (Botsch & Kobbelt 2004, "A remeshing approach to
multiresolution modeling").
"""

import numpy as np

from flx.geometry.arrays import area_normals, length_of, mark
from flx.geometry.remesh.finishing import finish
from flx.geometry.remesh.operators import NO_PAIRS, collapse_edges, flip_edges, split_edges
from flx.geometry.remesh.smoothing import ReferenceSurface, smooth
from flx.geometry.topology import edge_lengths, invariants, topology
from flx.types import Faces, Triangulation, Vertices

COARSENING = 1.4  # edge length of the random coarse mesh, in wanted edge lengths; at 1.0 copies share 74 %
ROUNDS = 2  # rounds of split, collapse, flip and smooth
FEW = 0.015  # share of the vertices; a round with fewer collapses than this is the last
LONGEST, SHORTEST = 4 / 3, 0.8  # edges are split above, collapsed below, in wanted lengths (Botsch & Kobbelt)


def remesh(vertices: Vertices, faces: Faces, count: int, seed: int) -> Triangulation:
    """An isotropic triangulation of a surface with exactly `count` vertices, a different one for each seed.

    The input is a manifold, consistently oriented mesh, open or closed, of any density. Components, Euler
    characteristic and boundary loops are preserved; so are boundaries and creases (faces that bend by more
    than 60° along at least four edges). The two creases of a wall thinner than a third of an edge become one.
    The same seed gives the same bits on the same machine. Takes about 3 CPU seconds for 30,000 vertices.

    Raises ValueError if the input is not such a mesh, or cannot be reduced to so few vertices.
    """
    shape = invariants(vertices, faces)
    if count < 4:
        raise ValueError(f"no surface has a triangulation of {count} vertices; ask for more vertices")
    area = length_of(area_normals(vertices, faces)).sum() / 2
    length = float(np.sqrt(2 * area / (np.sqrt(3) * count)))  # edge length if all faces were equilateral
    rng = np.random.default_rng(seed)
    mesh = Triangulation(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, np.int64))
    surface = ReferenceSurface(*mesh, length)
    mesh = _coarsen(mesh, surface, length, rng)
    for _ in range(ROUNDS):
        mesh = _split_long(mesh, LONGEST * length, rng)
        mesh = _collapse_short(mesh, length, rng)
        mesh = smooth(flip_edges(mesh, rng, delaunay=False, passes=4), surface, passes=2)
        mesh = _settle(mesh, count, length, rng)
        mesh = smooth(flip_edges(mesh, rng, delaunay=False, passes=4), surface, passes=1)
    mesh = finish(flip_edges(mesh, rng, delaunay=True, passes=8), surface, rng)
    if len(mesh.vertices) != count or invariants(*mesh) != shape:
        raise ValueError(
            f"remeshing {len(vertices)} vertices ({shape}) to {count} ended at {len(mesh.vertices)} "
            f"({invariants(*mesh)}); ask for more vertices"
        )
    return mesh


def _coarsen(mesh, surface, length, rng):
    """Collapse at random to a coarse mesh, which makes copies independent of the input and of each other."""
    mesh = _split_long(mesh, LONGEST * COARSENING * length, rng)
    mesh = smooth(mesh, surface, passes=1)
    mesh = _collapse_short(mesh, COARSENING * length, rng)
    return smooth(flip_edges(mesh, rng, delaunay=False, passes=4), surface, passes=2)


def _split_long(mesh, longest, rng):
    """Split until no edge is longer than `longest`."""
    while True:
        topo = topology(mesh.faces, len(mesh.vertices))
        long = edge_lengths(mesh.vertices, topo) > longest
        if not long.any():
            return mesh
        mesh = split_edges(mesh, topo, long, rng)


def _collapse_short(mesh, length, rng):
    """Collapse edges shorter than 0.8 `length` until few collapses are possible."""
    refused = NO_PAIRS
    while True:
        mesh, done, refused = collapse_edges(mesh, SHORTEST * length, LONGEST * length, rng, refused=refused)
        if done < FEW * len(mesh.vertices):
            return mesh


def _settle(mesh, count, length, rng):
    """Bring the mesh to `count` vertices: collapse short edges under ever weaker conditions, or split."""
    for shortest, longest, bend in ((1.3, 2.0, 0.3), (2.0, 3.0, 0.1), (np.inf, np.inf, -1.0)):
        done, refused = 1, NO_PAIRS
        while done and len(mesh.vertices) > count:
            surplus = len(mesh.vertices) - count
            mesh, done, refused = collapse_edges(
                mesh, shortest * length, longest * length, rng, surplus, bend, refused
            )
    while len(mesh.vertices) < count:
        mesh = _split_longest(mesh, count - len(mesh.vertices), rng)
    return mesh


def _split_longest(mesh, most, rng):
    """Split up to `most` of the edges that are the longest in both of their faces, the longest first."""
    topo = topology(mesh.faces, len(mesh.vertices))
    lengths = edge_lengths(mesh.vertices, topo)
    longest = np.zeros(len(lengths))
    np.maximum.at(longest, topo.face_edges, lengths[topo.face_edges].max(1)[:, None])
    ids = np.flatnonzero(lengths >= longest)
    ids = ids[np.argsort(-lengths[ids], kind="stable")[:most]]
    return split_edges(mesh, topo, mark(len(lengths), ids), rng)
