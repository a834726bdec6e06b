"""How deep a denoising network is, and how much of the surface each vertex sees through it.

Few rings, so that it learns what textures are made of and not the one texture (paper, "Denoising network").
"""

import jax
import numpy as np
from jaxtyping import Bool

from flx.types import MeshTables, OneRings

Blocks = tuple[int, int, int]  # fine before pooling, coarse, fine after

# From the smallest network to the paper's, one block at a time; the first is taken whatever the mesh.
_DEPTHS: tuple[Blocks, ...] = (
    (1, 1, 1),
    (1, 1, 2),
    (1, 2, 2),
    (2, 2, 2),
    (2, 2, 3),
    (2, 3, 3),
    (2, 3, 4),
    (2, 4, 4),
)

_RINGS = (2, 4, 2)  # fine rings a block of each part looks further: two convolutions, one coarse ring is two

_LARGEST_REACH = 0.085  # of the vertices; the paper's 28 rings are 0.081 of 30K


def blocks_for(vertices: int) -> Blocks:
    """The largest network whose R rings hold at most 8.5 % of the vertices, 3R(R+1) of them on a flat mesh.

    Never larger than the paper's, never smaller than one block of each kind.
    """

    def share(blocks: Blocks) -> float:
        rings = sum(a * b for a, b in zip(_RINGS, blocks, strict=True))
        return 3 * rings * (rings + 1) / vertices

    return next((b for b in reversed(_DEPTHS) if share(b) <= _LARGEST_REACH), _DEPTHS[0])


def reach(tables: MeshTables, blocks: Blocks, sources: int = 16) -> float:
    """The share of the vertices that can change the output at one vertex, the mean over `sources` of them.

    Breadth first through the network, backwards, pooling and the skip included. (The norms see the whole
    surface, but only as one mean a channel.)
    """
    fine, pooling, coarse = jax.tree.map(np.asarray, tables)
    real = np.flatnonzero(fine.masses > 0)
    chosen = real[np.linspace(0, len(real) - 1, min(sources, len(real))).astype(int)]
    before, middle, after = blocks

    def grown(seen: Bool[np.ndarray, "N S"], rings: OneRings, count: int) -> Bool[np.ndarray, "N S"]:
        for _ in range(2 * count):  # two convolutions a block
            seen = np.any(seen[np.asarray(rings.neighbors)], axis=1)
        return seen

    seen = np.zeros((len(fine.masses), len(chosen)), bool)
    seen[chosen, np.arange(len(chosen))] = True
    seen = grown(seen, fine, after)
    clusters = np.zeros((len(coarse.masses), len(chosen)), bool)
    np.logical_or.at(clusters, pooling.parents[real], seen[real])
    below = grown(clusters, coarse, middle)[pooling.parents]
    return float(grown(seen | below, fine, before)[real].mean())
