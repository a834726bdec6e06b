"""Baselines for the FL-VAE: other ways to store a texture in a few numbers per vertex.

A method takes a `Subject` and returns a function that gives the colours of its points. Vertex colours take 3
numbers per vertex; both kinds of principal components take 16, like the FL-VAE, and are fitted to a folder of
images. The paper's own baseline, an FL-VAE whose decoder interpolates invariants, is a separate weights file.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float, Float32

from flx.config import FLVAE, Images
from flx.geometry.sampling import surface_colors, transfer
from flx.models.codec import frame
from flx.pipeline.codec import Codec, initial_params
from flx.pipeline.patches import ImagePatches, colors_at, first_rings
from flx.types import Queries, RingSamples, SurfacePoints, TexturedMesh, Triangulation

COEFFICIENTS = 16  # numbers per vertex
FITTED_RINGS = 16_384  # one-rings that principal components are fitted to
GRID = 17  # points per side of a component's patch
EXTENT = 2.6  # half its side, in mean vertex radii
RINGS_AT_ONCE, POINTS_AT_ONCE = 1024, 16_384  # one-rings encoded and points decoded at a time


class Subject(NamedTuple):
    """A textured mesh, one triangulation of it, and the colours sampled in its one-rings."""

    mesh: TexturedMesh
    triangulation: Triangulation
    rings: RingSamples


Painter = Callable[[Queries], Float32[Any, "P 3"]]  # colours at points of the triangulation
Method = Callable[[Subject], Painter]


def field_latents(codec: Codec) -> Method:
    """The field-latent VAE: encode, then decode."""

    return lambda subject: codec.decoder(codec.encode(subject.rings))


def vertex_colours(subject: Subject) -> Painter:
    """The texture's colour at each vertex, interpolated over the faces."""
    mesh, triangulation = subject.mesh, subject.triangulation
    vertices, corners = np.unique(triangulation.faces, return_index=True)
    points = SurfacePoints(corners // 3, np.eye(3)[corners % 3])
    colors = np.zeros((len(triangulation.vertices), 3), np.float32)
    colors[vertices] = surface_colors(mesh, transfer(points, triangulation, mesh))
    return lambda points: np.einsum("pkc,pk->pc", colors[points.vertices], points.barycentrics)


def frame_components(images: ImagePatches) -> Method:
    """The codec of `models.codec.frame` before training: principal components only, with all MLPs zero."""
    config = FLVAE(encoder="frame", invariants=3, width=8, depth=1, edges=1, precision="float32")
    rings = first_rings(images, 0, FITTED_RINGS)
    params = frame.start_from_principal_components(initial_params(config, 0), rings)
    silent = jax.tree_util.tree_map_with_path(
        lambda path, leaf: jnp.zeros_like(leaf) if path[-1].key in ("kernel", "bias") else leaf, params
    )
    return field_latents(Codec(config, silent))


def open_images(folder: Path) -> ImagePatches:
    """Patches on the images of a folder, at the scales that the released FL-VAE is trained on."""
    return ImagePatches(Images(str(folder)), FLVAE(), 64)


# --- principal components in the vertex's own frame


class Components(NamedTuple):
    """Principal components as coloured patches on a square grid, for coefficients of unit variance."""

    mean: Float32[Any, "G 3"]
    patches: Float32[Any, "G 3 N"]
    noise: float  # mean variance of the residual


def components(images: ImagePatches) -> Method:
    """Principal components of coloured patches: the best code that is linear in the ring."""
    fitted = fit_components(images)

    def method(subject: Subject) -> Painter:
        z = encode_components(fitted, subject.rings)
        return lambda points: np.asarray(decode_components(fitted, z, points))

    return method


def fit_components(images: ImagePatches) -> Components:
    """Fit to patches of the images, each grid point weighted by the density of one-ring samples there."""
    axis = np.linspace(-EXTENT, EXTENT, GRID)
    grid = (axis[None, :] + 1j * axis[:, None]).ravel().astype(np.complex64)
    places = jnp.broadcast_to(grid, (images.batch, len(grid)))
    read = jax.jit(lambda pictures, placement: colors_at(pictures, placement, places)[0])
    batches = range(-(-FITTED_RINGS // images.batch))
    patches = [np.asarray(read(images.images, images.placement(step))) for step in batches]
    x = np.concatenate(patches).reshape(-1, 3 * len(grid)).astype(np.float64)
    mean = x.mean(0)
    roots = np.sqrt(np.repeat(_density(images), 3))
    covariance = np.cov((x - mean).T) * roots * roots[:, None]
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[::-1], vectors[:, ::-1][:, :COEFFICIENTS]
    scaled = vectors * np.sqrt(values[:COEFFICIENTS]) / roots[:, None]
    shape = (len(grid), 3)
    return Components(
        mean.reshape(shape).astype(np.float32),
        scaled.reshape(*shape, COEFFICIENTS).astype(np.float32),
        float(values[COEFFICIENTS:].sum() / 3),
    )


def _density(images: ImagePatches) -> Any:
    """The share of one-ring samples at each grid point, with a small positive floor."""
    z: Any = np.asarray(images.bank.logs).ravel()
    edges = (np.arange(GRID + 1) - 0.5) / (GRID - 1) * 2 * EXTENT - EXTENT
    y, x = np.clip(z.imag, -EXTENT, EXTENT), np.clip(z.real, -EXTENT, EXTENT)
    counts = np.histogram2d(y, x, [edges, edges])[0]
    counts += 1e-3 * counts.max()
    return (counts / counts.sum()).ravel()


@jax.jit
def encode_components(fitted: Components, rings: RingSamples) -> Float[Array, "V N"]:
    """The most likely coefficients of each ring given its samples (probabilistic PCA, Tipping & Bishop)."""

    def one(ring: RingSamples) -> Array:
        mean, patches = _at(fitted, ring.logs)
        patches = patches.reshape(-1, COEFFICIENTS)
        gram = patches.T @ patches + fitted.noise * jnp.eye(COEFFICIENTS)
        return jnp.linalg.solve(gram, patches.T @ (ring.colors - mean).ravel())

    return jax.lax.map(one, jax.tree.map(jnp.asarray, rings), batch_size=RINGS_AT_ONCE)


@jax.jit
def decode_components(fitted: Components, z: Float[Array, "V N"], points: Queries) -> Float[Array, "P 3"]:
    """Colours in [0, 1]: the patches of the three corners at each point, blended barycentrically."""

    def one(point: Queries) -> Array:
        mean, patches = _at(fitted, point.logs)
        predicted = mean + jnp.einsum("kcn,kn->kc", patches, z[point.vertices])
        return jnp.clip(point.barycentrics @ predicted, 0, 1)

    return jax.lax.map(one, jax.tree.map(jnp.asarray, points), batch_size=POINTS_AT_ONCE)


def _at(fitted: Components, logs: Complex[Any, "K"]) -> tuple[Float[Array, "K 3"], Float[Array, "K 3 N"]]:
    """Mean and patches at points around the vertex, bilinear; clamped at the border of the grid."""
    place = jnp.stack([jnp.imag(logs), jnp.real(logs)], -1)
    place = jnp.clip((place + EXTENT) * (GRID - 1) / (2 * EXTENT), 0, GRID - 1)
    corner = jnp.minimum(place.astype(jnp.int32), GRID - 2)
    down, right = jnp.moveaxis(place - corner, -1, 0)
    first = corner[..., 0] * GRID + corner[..., 1]
    steps = ((0, (1 - down) * (1 - right)), (1, (1 - down) * right), (GRID, down * (1 - right)))
    steps = (*steps, (GRID + 1, down * right))
    mean = sum(weight[:, None] * jnp.asarray(fitted.mean)[first + step] for step, weight in steps)
    patches = sum(weight[:, None, None] * jnp.asarray(fitted.patches)[first + step] for step, weight in steps)
    return jnp.asarray(mean), jnp.asarray(patches)
