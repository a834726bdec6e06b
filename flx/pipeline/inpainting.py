"""Inpainting: some texels of the asset's texture are kept to the bit, and the rest is made to fit them.

A mask has the size of the texture. It is carried to the vertices by area: a vertex is held where at least
half of its one-ring is kept. While codes are sampled, held vertices have the codes of the input, as noisy as
the others are. In the new texture, kept texels are the input's own; up to one ring beyond them, new texels
take over what the codec missed of the kept ones.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from jaxtyping import Bool, Float32, Float64, Int
from scipy.spatial import KDTree

from flx.assets.asset import Painting
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import diffuse
from flx.geometry.copies import sample_rings
from flx.geometry.sampling import face_normals, positions
from flx.pipeline.canvas import Canvas
from flx.pipeline.generator import Generator
from flx.pipeline.masks import Kept, continued
from flx.types import SurfacePoints, TexturedMesh, Triangulation

HELD = 0.5  # share of its one-ring that is kept, from which a vertex is held
REPEATS = (5, 1)  # each five steps twice, for old and new to fit; three or five times are no better
NEAREST = 8  # kept texels from which a new one takes over what the codec missed; 32 would smooth too much


# --- at the vertices


class Inpainting(NamedTuple):
    """What is kept, on one triangulation."""

    kept: Kept
    shares: Float32[np.ndarray, "V"]  # of each one-ring that is kept
    hook: Partial | None  # for samplers


def inpainting(generator: Generator, kept: Kept, triangulation: Triangulation) -> Inpainting:
    """The vertices of a triangulation that are held, and their codes."""
    samples = generator.codec.config.samples
    shares = kept_shares(generator.asset.mesh, kept, triangulation, samples)
    rings = sample_rings(continued(generator.asset.mesh, kept), triangulation, samples, 0)
    codes = generator.scaling.to_diffusion(generator.codec.encode(rings))
    noise = tangent_noise(jax.random.key(0), codes.shape)
    alphas = jnp.asarray(generator.alphas, jnp.float32)
    return Inpainting(
        kept, shares, Partial(held, jnp.asarray(shares >= HELD), jnp.asarray(codes), noise, alphas)
    )


def held(where: Array, codes: Array, noise: Array, alphas: Array, z: Array, s: Array, key: Array) -> Array:
    """A hook for samplers: some vertices have codes of their own, with the same noise at every level.

    The path of a deterministic sampler from a noise is the same noise, ever less of it: a fresh one at each
    step would be a jolt to its neighbours.
    """
    return jnp.where(where[:, None], diffuse(codes, noise, alphas[s.astype(int)]), z)


def kept_shares(
    mesh: TexturedMesh, kept: Kept, triangulation: Triangulation, samples: int
) -> Float32[np.ndarray, "V"]:
    """The share of each one-ring that is kept, by area; flat materials are kept."""
    masks = [np.full_like(image, 255) for image in mesh.textures]
    masks[kept.index] = np.uint8(255) * np.repeat(kept.texels[..., None], 3, 2)
    rings = sample_rings(mesh.with_layer(images=tuple(masks)), triangulation, samples, 0)
    return (rings.colors[..., 0] >= 0.5).mean(1, dtype=np.float32)


# --- in the texture


def restored(inpainting: Inpainting, canvas: Canvas, painting: Painting) -> Painting:
    """The painting with what is kept in its place, and the border blended up to one ring beyond it."""
    images, atlas = list(painting.images), canvas.atlases[inpainting.kept.index]
    assert atlas is not None
    kept = inpainting.kept.at_size(atlas.height, atlas.width)
    new = images[kept.index].reshape(-1, 3).copy()

    crossed: Any = (inpainting.shares > 0) & (inpainting.shares < 1)  # one-rings that the border crosses
    near = np.flatnonzero(crossed[canvas.triangulation.faces].any(1)[canvas.faces])
    texels = atlas.texels[near]
    old = kept.texels.ravel()[texels]
    missed = kept.image.reshape(-1, 3)[texels].astype(np.float32) - new[texels]
    if old.any() and not old.all():
        added = _carried(missed[old], *_places(canvas, near, old))
        new[texels[~old]] = np.rint(np.clip(new[texels[~old]] + added, 0, 255)).astype(np.uint8)
    images[kept.index] = np.where(kept.texels[..., None], kept.image, new.reshape(kept.image.shape))
    return painting._replace(maps={**painting.maps, "base_color": tuple(images)})


def _places(
    canvas: Canvas, chosen: Int[Any, "N"], old: Bool[Any, "N"]
) -> tuple[Float64[Any, "K 6"], Float64[Any, "M 6"]]:
    """Where kept texels are, and the others, in lengths of a mean edge.

    The normal is part of a place, which sets the two sides of a thin wall apart.
    """
    vertices, faces = canvas.triangulation
    points = SurfacePoints(canvas.faces[chosen], canvas.barycentrics[chosen].astype(np.float64))
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    spots = positions(vertices, faces, points) / np.linalg.norm(edges, axis=2).mean()
    places = np.concatenate([spots, face_normals(vertices, faces)[points.faces]], 1)
    return places[old], places[~old]


def _carried(
    values: Float32[Any, "K 3"], at: Float64[Any, "K 6"], to: Float64[Any, "M 6"]
) -> Float64[Any, "M 3"]:
    """Values at other places: the mean of the nearest by inverse squares of distances, fading to 0 at 1."""
    ranks: Any = range(1, NEAREST + 1)  # also of a single one: two dimensions
    distances, nearest = KDTree(at).query(to, ranks, distance_upper_bound=1.0)
    weights = 1 / np.maximum(distances, 1e-9) ** 2  # 0 for those that are too far, which have index K
    found = np.concatenate([values, np.zeros((1, 3), np.float32)])[nearest]
    mean = np.einsum("mn,mnc->mc", weights, found) / np.maximum(weights.sum(1), 1e-9)[:, None]
    near = np.clip(1 - distances[:, :1], 0, 1)
    return mean * near**2 * (3 - 2 * near)
