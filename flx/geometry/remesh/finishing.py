"""The last touch of a remeshed copy: it reaches what it missed, its sharpest angles widen, its gaps close.

Smoothing cares for the mean; here a vertex moves where its worst face gets better, and otherwise stays. Few
vertices are asked, so it costs little.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool

from flx.geometry.arrays import dot
from flx.geometry.remesh.features import features
from flx.geometry.remesh.operators import flip
from flx.geometry.remesh.smoothing import Surface, smooth
from flx.geometry.remesh.stars import Stars, independent, sharpest_cosines
from flx.geometry.remesh.tighten import FAIR, FEW_SHARP, gap_to_close, reach, tighten
from flx.geometry.topology import mark, topology
from flx.types import Triangulation

SHARP = np.cos(np.radians(38.0))  # corners below 38° are asked to widen
TRIES, MOST_TRIES = 24, 96  # of each vertex asked; more where many corners stay sharp
NARROW = np.cos(np.radians(20.0))  # corners sharper than that are needles: features give way to them
REACHES = 3  # each followed by smoothing, which loses a few points again


def finish(mesh: Triangulation, surface: Surface, rng: np.random.Generator) -> Triangulation:
    """Reach what the mesh misses, widen its angles, close what gaps are left."""
    gap = gap_to_close(mesh, surface)
    pinned, probes = np.zeros(len(mesh.vertices), bool), np.arange(len(surface.probes))
    for _ in range(REACHES):
        mesh, pinned, probes = reach(mesh, surface, gap, pinned, probes)
        mesh = flip(smooth(mesh, surface, 1, pinned), rng, delaunay=True, passes=2)
    return tighten(widen_angles(mesh, pinned, surface, rng), surface, gap, rng)


def widen_angles(
    mesh: Triangulation, pinned: Bool[Any, "V"], surface: Surface, rng: np.random.Generator
) -> Triangulation:
    """Move vertices of sharp faces at random, on the surface, and keep what widens their sharpest corner.

    Features slide along themselves and corners stay, but for needles; `pinned` vertices stay.
    """
    vertices, faces = mesh[0].copy(), mesh[1]
    count = len(vertices)
    topo = topology(faces, count)
    kind = features(vertices, faces, topo)[1]
    rim = mark(count, topo.edges[topo.boundary].ravel())
    cosines = sharpest_cosines(vertices, faces)
    for attempt in range(MOST_TRIES):
        if attempt >= TRIES and (cosines > FAIR).mean() < FEW_SHARP:
            break
        needles = mark(count, faces[cosines > NARROW].ravel())
        asked = np.unique(faces[cosines > SHARP])
        asked = asked[((kind[asked] < 2) | needles[asked]) & ~pinned[asked]]
        asked = asked[independent(topo.edges, count, asked, rng.permutation(len(asked)))]
        stars = Stars(vertices, faces, asked)
        step = rng.normal(size=(len(asked), 3)) * (0.2 * surface.length * rng.random(len(asked)))[:, None]
        step -= dot(step, stars.normals)[:, None] * stars.normals
        landed, trusted = surface.land(vertices[asked] + step, stars.normals, kind[asked], rim[asked])
        moved = vertices.copy()
        moved[asked] = landed
        after = sharpest_cosines(moved, stars.faces)
        better = trusted & stars.keep_facing(moved) & (stars.worst(after) < stars.worst(cosines[stars.ids]))
        vertices[asked[better]] = landed[better]
        kept = better[stars.owners]
        cosines[stars.ids[kept]] = after[kept]
    return Triangulation(vertices, faces)
