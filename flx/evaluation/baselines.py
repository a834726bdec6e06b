"""Other ways to keep a texture in a few numbers a vertex: what the FL-VAE is measured against.

A method learns a `Subject` and answers with what colours its points. Vertex colours take 3 numbers a
vertex; both kinds of principal components take 16, like the FL-VAE, and are fitted to a folder of images. The
paper's own comparison, an FL-VAE whose decoder interpolates invariants, is another file of weights.
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

NUMBERS = 16  # a vertex
RINGS = 16_384  # fitted to
GRID, REACH = 17, 2.6  # points a side, and mean radii from the vertex, of the patch a component covers
VERTICES, POINTS = 1024, 16_384  # worked at once


class Subject(NamedTuple):
    """A textured mesh, one triangulation of it, and what was sampled there."""

    mesh: TexturedMesh
    triangulation: Triangulation
    rings: RingSamples


Paint = Callable[[Queries], Float32[Any, "P 3"]]  # colours at points of the triangulation
Method = Callable[[Subject], Paint]


def field_latents(codec: Codec) -> Method:
    """The field-latent VAE, there and back."""

    return lambda subject: codec.decoder(codec.encode(subject.rings))


def vertex_colours(subject: Subject) -> Paint:
    """The texture's colour at each vertex, interpolated over the faces."""
    mesh, triangulation = subject.mesh, subject.triangulation
    vertices, corners = np.unique(triangulation.faces, return_index=True)
    points = SurfacePoints(corners // 3, np.eye(3)[corners % 3])
    colors = np.zeros((len(triangulation.vertices), 3), np.float32)
    colors[vertices] = surface_colors(mesh, transfer(points, *triangulation, mesh.vertices, mesh.faces))
    return lambda points: np.einsum("pkc,pk->pc", colors[points.vertices], points.barycentrics)


def frame_components(images: ImagePatches) -> Method:
    """The codec of `models.codec.frame` as training finds it: its principal components, its MLPs silent."""
    config = FLVAE(encoder="frame", invariants=3, width=8, depth=1, edges=1, precision="float32")
    params = frame.start_from_principal_components(initial_params(config, 0), first_rings(images, 0, RINGS))
    silent = jax.tree_util.tree_map_with_path(
        lambda path, leaf: jnp.zeros_like(leaf) if path[-1].key in ("kernel", "bias") else leaf, params
    )
    return field_latents(Codec(config, silent))


def open_images(folder: Path) -> ImagePatches:
    """Patches over the images of a folder, at the scales the released FL-VAE is trained on."""
    return ImagePatches(Images(str(folder)), FLVAE(), 64)


# --- principal components in the vertex's own frame


class Components(NamedTuple):
    """Coloured patches on a square grid around the vertex, scaled to coefficients of unit variance."""

    mean: Float32[Any, "G 3"]
    patches: Float32[Any, "G 3 N"]
    noise: float  # variance of what they leave out


def components(images: ImagePatches) -> Method:
    """Principal components of coloured patches: no code that is linear in its ring keeps more."""
    fitted = fit_components(images)

    def learnt(subject: Subject) -> Paint:
        z = encode(fitted, subject.rings)
        return lambda points: np.asarray(decode(fitted, z, points))

    return learnt


def fit_components(images: ImagePatches) -> Components:
    """Fit to patches of the images; a point counts as often as a one-ring samples there."""
    axis = np.linspace(-REACH, REACH, GRID)
    grid = (axis[None, :] + 1j * axis[:, None]).ravel().astype(np.complex64)
    places = jnp.broadcast_to(grid, (images.batch, len(grid)))
    read = jax.jit(lambda pictures, lay: colors_at(pictures, lay, places)[0])
    batches = range(-(-RINGS // images.batch))
    patches = [np.asarray(read(images.images, images.lay(step))) for step in batches]
    x = np.concatenate(patches).reshape(-1, 3 * len(grid)).astype(np.float64)
    mean = x.mean(0)
    roots = np.sqrt(np.repeat(_density(images), 3))
    covariance = np.cov((x - mean).T) * roots * roots[:, None]
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[::-1], vectors[:, ::-1][:, :NUMBERS]
    scaled = vectors * np.sqrt(values[:NUMBERS]) / roots[:, None]
    shape = (len(grid), 3)
    return Components(
        mean.reshape(shape).astype(np.float32),
        scaled.reshape(*shape, NUMBERS).astype(np.float32),
        float(values[NUMBERS:].sum() / 3),
    )


def _density(images: ImagePatches) -> Any:
    """The share of a one-ring's samples at each point of the grid; nowhere quite nothing."""
    z: Any = np.asarray(images.bank.logs).ravel()
    edges = (np.arange(GRID + 1) - 0.5) / (GRID - 1) * 2 * REACH - REACH
    counts = np.histogram2d(np.clip(z.imag, -REACH, REACH), np.clip(z.real, -REACH, REACH), [edges, edges])[0]
    counts += 1e-3 * counts.max()
    return (counts / counts.sum()).ravel()


@jax.jit
def encode(fitted: Components, rings: RingSamples) -> Float[Array, "V N"]:
    """The most likely coefficients of each ring, given its samples (Tipping and Bishop's PCA)."""

    def one(ring: RingSamples) -> Array:
        mean, patches = _at(fitted, ring.logs)
        patches = patches.reshape(-1, NUMBERS)
        gram = patches.T @ patches + fitted.noise * jnp.eye(NUMBERS)
        return jnp.linalg.solve(gram, patches.T @ (ring.colors - mean).ravel())

    return jax.lax.map(one, jax.tree.map(jnp.asarray, rings), batch_size=VERTICES)


@jax.jit
def decode(fitted: Components, z: Float[Array, "V N"], points: Queries) -> Float[Array, "P 3"]:
    """Colours in [0, 1]: what the corners' patches show at each point, blended barycentrically."""

    def one(point: Queries) -> Array:
        mean, patches = _at(fitted, point.logs)
        shown = mean + jnp.einsum("kcn,kn->kc", patches, z[point.vertices])
        return jnp.clip(point.barycentrics @ shown, 0, 1)

    return jax.lax.map(one, jax.tree.map(jnp.asarray, points), batch_size=POINTS)


def _at(fitted: Components, logs: Complex[Any, "K"]) -> tuple[Float[Array, "K 3"], Float[Array, "K 3 N"]]:
    """Mean and patches at points around the vertex, bilinear; beyond the grid, as at its border."""
    place = jnp.stack([jnp.imag(logs), jnp.real(logs)], -1)
    place = jnp.clip((place + REACH) * (GRID - 1) / (2 * REACH), 0, GRID - 1)
    corner = jnp.minimum(place.astype(jnp.int32), GRID - 2)
    down, right = jnp.moveaxis(place - corner, -1, 0)
    first = corner[..., 0] * GRID + corner[..., 1]
    steps = ((0, (1 - down) * (1 - right)), (1, (1 - down) * right), (GRID, down * (1 - right)))
    steps = (*steps, (GRID + 1, down * right))
    mean = sum(weight[:, None] * jnp.asarray(fitted.mean)[first + step] for step, weight in steps)
    patches = sum(weight[:, None, None] * jnp.asarray(fitted.patches)[first + step] for step, weight in steps)
    return jnp.asarray(mean), jnp.asarray(patches)
