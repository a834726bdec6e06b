"""How deep a denoising network is, and how much of the surface each vertex sees through it. NumPy only.

Few rings, so that it learns what textures are made of and not the one texture (paper, "Denoising network").
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from flx.config import FLDM, FLVAE, Blocks
from flx.types import MeshTables, OneRings

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
_LARGEST_REACH = 0.085  # share of the vertices; the paper's 28 rings are 0.081 of 30K


def complete(model: FLDM, codec: FLVAE, vertices: int, labels: int = 0, directions: int = 0) -> FLDM:
    """The model that is really trained: what the experiment leaves open (None) follows from codec and mesh.

    It has as many conditions as there are labels, and a vector condition where there is a direction. Raises
    ValueError where the experiment asks for something that the codec's codes or these do not fit.
    """
    for name in ("latents", "invariants"):
        wanted, actual = getattr(model, name), getattr(codec, name)
        if wanted is not None and wanted != actual:
            raise ValueError(
                f"model.{name} is {wanted} but the FL-VAE has {actual}; leave it out, or name another FL-VAE "
                "with --weights"
            )
    if model.conditions not in (0, labels):
        raise ValueError(
            f"model.conditions is {model.conditions} but there are {labels} labels; leave it out, and name "
            "the labels with --surface.labels"
        )
    if model.directions not in (0, directions):
        raise ValueError(
            f"model.directions is {model.directions} but there are {directions}; leave it out, and give a "
            "direction with --surface.direction"
        )
    network = model.network or ("mixed" if codec.invariants else "vectors")
    if network == "vectors" and codec.invariants:
        raise ValueError(
            f"model.network is 'vectors' but {codec.invariants} of the FL-VAE's {codec.latents} channels are "
            "invariant; use --model.network mixed, or --weights vectors"
        )
    return replace(
        model,
        network=network,
        conditions=labels,
        directions=directions,
        latents=codec.latents,
        invariants=codec.invariants,
        blocks=model.blocks or blocks_for(vertices),
    )


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
    surface, but only as one mean for each channel.)
    """
    fine, pooling, coarse = tables
    real = np.flatnonzero(np.asarray(fine.masses) > 0)
    chosen = real[np.linspace(0, len(real) - 1, min(sources, len(real))).astype(int)]
    before, middle, after = blocks
    parents = np.asarray(pooling.parents)

    def grown(seen: Bool[np.ndarray, "N S"], rings: OneRings, count: int) -> Bool[np.ndarray, "N S"]:
        for _ in range(2 * count):  # two convolutions a block
            seen = np.any(seen[np.asarray(rings.neighbors)], axis=1)
        return seen

    seen = np.zeros((len(fine.masses), len(chosen)), bool)
    seen[chosen, np.arange(len(chosen))] = True
    seen = grown(seen, fine, after)
    clusters = np.zeros((len(coarse.masses), len(chosen)), bool)
    np.logical_or.at(clusters, parents[real], seen[real])
    below = grown(clusters, coarse, middle)[parents]
    return float(grown(seen | below, fine, before)[real].mean())
