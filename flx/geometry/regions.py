"""Regions of like colour on a surface, coherent rather than exact: a proposal for labels."""

import warnings
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_array, diags_array
from skimage.color import rgb2lab

from flx.geometry.arrays import Rng
from flx.types import Faces

ROUNDS = 12  # means over one-rings: details smaller than about three rings do not count
TRIES = 8  # of k-means; the tightest is taken

# Okabe and Ito (2008): told apart by all, and by programs.
PALETTE = np.array(
    [
        *[(230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)],
        *[(0, 114, 178), (213, 94, 0), (204, 121, 167), (0, 0, 0)],
    ],
    np.uint8,
)


def regions(colors: Float32[Any, "V 3"], faces: Faces, count: int, rng: Rng) -> Float64[Any, "V R"]:
    """How much each vertex belongs to each of `count` regions; the largest first.

    Colours are averaged over the surface and clustered (k-means in CIE Lab); the clusters are averaged again,
    so that borders are smooth and specks vanish.

    Raises ValueError where fewer regions are found.
    """
    mean = _mean_over_rings(faces, len(colors))
    features = rgb2lab(_smoothed(mean, colors.astype(np.float64)))
    least, best = np.inf, np.zeros(len(colors), int)
    for _ in range(TRIES):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an empty cluster: another try may have none
            centers, found = kmeans2(features, count, minit="++", rng=rng)
        spread = np.square(features - centers[found]).sum()
        if spread < least:
            least, best = spread, found
    shares = _smoothed(mean, np.eye(count)[best])
    areas = np.bincount(shares.argmax(1), minlength=count)
    if not areas.all():
        raise ValueError(f"its colours make {np.count_nonzero(areas)} regions, not {count}; ask for fewer")
    return shares[:, np.argsort(-areas, kind="stable")]


def _smoothed(mean: Any, values: Float64[Any, "V C"]) -> Float64[Any, "V C"]:
    for _ in range(ROUNDS):
        values = mean @ values
    return values


def _mean_over_rings(faces: Faces, vertices: int) -> Any:
    """The sparse matrix that averages each vertex with its neighbours."""
    edges: Int[Any, "E 2"] = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    starts, ends = np.concatenate([edges, edges[:, ::-1]]).T
    ring = coo_array((np.ones(len(starts)), (starts, ends)), (vertices, vertices)).tocsr()
    ring.data[:] = 1  # an edge of two faces counts once
    ring = ring + diags_array(np.ones(vertices))
    return diags_array(1 / ring.sum(1)) @ ring
