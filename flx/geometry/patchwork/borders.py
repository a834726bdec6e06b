"""Where a piece ends between the vertices: along smooth lines instead of from triangle to triangle."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int
from scipy.sparse import csr_array, diags_array

from flx.geometry.patchwork.cuts import Patchwork
from flx.types import Queries

SMOOTHED = 2  # means of a vertex and its ring, by which belonging to a piece becomes smooth
SHARPNESS = 6  # power of the barycentrics by which the corners of a face are blended in a piece
STEEPNESS = 12  # power of belonging by which pieces are blended; the border is then a third of an edge wide


class Belonging(NamedTuple):
    """How much each vertex belongs to each piece."""

    pieces: Int[Any, "V"]  # that of each vertex
    shares: csr_array  # vertices × pieces; those of a vertex add up to 1


def belonging(work: Patchwork) -> Belonging:
    """Of the vertices of a patchwork."""
    pieces, count = work.pieces(), len(work.target)
    rows, slots = np.nonzero(work.target.used)
    around = work.target.rings.neighbors[rows, slots]
    ring = csr_array((np.ones(len(rows), np.float32), (rows, around)), shape=(count, count))
    ring = diags_array(1 / ring.sum(1)) @ ring
    shares = csr_array((np.ones(count, np.float32), (np.arange(count), pieces)))
    for _ in range(SMOOTHED):
        shares = (shares + ring @ shares) / 2
    return Belonging(pieces, csr_array(shares, dtype=np.float32))


def corner_weights(of: Belonging, queries: Queries) -> Float32[Any, "P 3"]:
    """How much each corner of a point's face counts there; the three add up to 1.

    In a piece the nearest corner counts most. Where pieces meet, the one counts most to which the point
    belongs most, by what its corners belong to.
    """
    barycentrics = np.asarray(queries.barycentrics, np.float32)
    weights = barycentrics**SHARPNESS
    own = of.pieces[queries.vertices]
    mixed = np.flatnonzero((own != own[:, :1]).any(1))
    if len(mixed):
        own, near, shares = own[mixed], weights[mixed], barycentrics[mixed]
        triples, which = np.unique(queries.vertices[mixed], axis=0, return_inverse=True)
        corners, pieces = np.broadcast_arrays(triples[:, :, None], of.pieces[triples][:, None])
        there = np.asarray(of.shares[corners.ravel(), pieces.ravel()]).reshape(-1, 3, 3)
        belongs = np.einsum("pm,pmc->pc", shares, there[which.reshape(-1)])
        alike = (own[:, :, None] == own[:, None]).astype(np.float32)
        whole, among = (np.einsum("pm,pmc->pc", part, alike) for part in (shares, near))
        belongs /= belongs.max(1, keepdims=True)
        weights[mixed] = belongs**STEEPNESS * whole * near / np.maximum(among, np.float32(1e-30))
    return weights / weights.sum(1, keepdims=True)
