"""The last passes over a remeshed copy: reach what it misses, widen its sharpest angles, close its gaps.

Smoothing improves the mean face. Here a vertex moves only if its worst face improves. Few vertices are tried,
so it costs little.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from flx.geometry.arrays import Rng, mark
from flx.geometry.remesh.features import features
from flx.geometry.remesh.operators import flip_edges
from flx.geometry.remesh.smoothing import ReferenceSurface, smooth
from flx.geometry.remesh.stars import Stars, independent, sharpest_cosines
from flx.geometry.remesh.tighten import (
    FAIR_COSINE,
    FEW_SHARP,
    HOPELESS,
    gap_to_close,
    pin_missed_points,
    tighten,
)
from flx.geometry.topology import topology
from flx.types import Triangulation

SHARP_COSINE = np.cos(np.radians(38.0))  # vertices of faces with a smaller angle are moved
TRIES, MOST_TRIES = 24, 96  # rounds of random moves; up to the second number while many stay sharp, not most
NARROW_COSINE = np.cos(np.radians(20.0))  # in faces with a smaller angle, feature vertices may move too
PIN_ROUNDS = 3  # rounds of pinning; the smoothing after each loses a few points again


def finish(mesh: Triangulation, surface: ReferenceSurface, rng: Rng) -> Triangulation:
    """Pin vertices to the points that the mesh misses, widen its angles, close the remaining gaps."""
    gap = gap_to_close(mesh, surface)
    pinned, probes = np.zeros(len(mesh.vertices), bool), np.arange(len(surface.probes))
    for _ in range(PIN_ROUNDS):
        mesh, pinned, probes = pin_missed_points(mesh, surface, gap, pinned, probes)
        mesh = flip_edges(smooth(mesh, surface, 1, pinned), rng, delaunay=True, passes=2)
    return tighten(widen_angles(mesh, pinned, surface, rng), surface, gap, rng)


def widen_angles(
    mesh: Triangulation, pinned: Bool[Any, "V"], surface: ReferenceSurface, rng: Rng
) -> Triangulation:
    """Move vertices of sharp faces at random on the surface; keep the moves that widen their sharpest corner.

    Feature vertices move along their curve and corners stay, except in needles; `pinned` vertices stay.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    topo = topology(faces, len(vertices))
    kind, rim = features(vertices, faces, topo)[1], topo.rim
    cosines = sharpest_cosines(vertices, faces)
    for attempt in range(MOST_TRIES):
        if attempt >= TRIES and not FEW_SHARP < (cosines > FAIR_COSINE).mean() < HOPELESS:
            break
        needles = mark(topo.count, faces[cosines > NARROW_COSINE])
        movers = np.unique(faces[cosines > SHARP_COSINE])
        movers = movers[((kind[movers] < 2) | needles[movers]) & ~pinned[movers]]
        movers = movers[independent(topo, movers, rng.permutation(len(movers)))]
        stars = Stars(vertices, faces, movers)
        goals = vertices[movers] + stars.random_steps(0.2 * surface.length, rng)
        landed, on_own_side = surface.project(goals, stars.normals, kind[movers], rim[movers])
        moved = vertices.copy()
        moved[movers] = landed
        after = sharpest_cosines(moved, stars.faces)
        better = stars.worst(after) < stars.worst(cosines[stars.ids])
        better &= on_own_side & stars.keep_facing(moved)
        vertices[movers[better]] = landed[better]
        improved = better[stars.owners]
        cosines[stars.ids[improved]] = after[improved]
    return Triangulation(vertices, faces)
