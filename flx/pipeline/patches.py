"""Training data of the field-latent VAE: planar meshes placed on images, batch by batch.

A bank of patches (neighbouring vertices of a random triangulation, points of their one-rings, and points of
the faces between them) is built once, with the functions that sample real meshes. Each batch places some of
them on images, with random scale, direction and stretch, and recolours half of them. One compiled function
makes it, on the device that trains.
"""

import hashlib
import math
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Complex64, Float, Int, UInt8
from PIL import Image

from flx.assets.formats.files import read_file
from flx.assets.formats.images import decode_image
from flx.config import FLVAE, Images
from flx.geometry.arrays import Rng, area_normals, length_of
from flx.geometry.copies import points_in_rings, queries_at
from flx.geometry.remesh.planar import planar
from flx.geometry.sampling import positions
from flx.geometry.tangent import TangentFrames, tangent_frames
from flx.pipeline.printed_pages import printed_pages
from flx.types import Queries, RingSamples, SurfacePoints, Triangulation

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
IMAGE_SIDE = 512  # side of an image in pixels
PATCH_VERTICES = 24  # vertices of a patch
SHEETS, SHEET_VERTICES, PATCHES = 24, 600, 64  # triangulations of the bank; vertices and patches of each


# --- images


def load_images(folder: Path) -> UInt8[Any, "N 512 512 3"]:
    """Every image in the folder and its subfolders, as a centred crop of 512² pixels.

    Raises ValueError if there is none, and for a file that is not an image of a known kind and bounded size.
    """
    if not (paths := image_files(folder)):
        raise ValueError(f"{folder} holds no images ({' '.join(SUFFIXES)}); name another --images.folder")
    return np.stack([_centred_crop(Image.fromarray(decode_image(read_file(p), str(p))[0])) for p in paths])


def image_files(folder: Path) -> list[Path]:
    """The image files in a folder and its subfolders."""
    return sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)


def _centred_crop(image: Image.Image) -> UInt8[Any, "512 512 3"]:
    """The central square of an RGB image; one that is too small is enlarged first."""
    scale = IMAGE_SIDE / min(image.size)
    if scale > 1:
        width, height = (max(IMAGE_SIDE, round(scale * n)) for n in image.size)
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    left, top = (image.width - IMAGE_SIDE) // 2, (image.height - IMAGE_SIDE) // 2
    return np.asarray(image.crop((left, top, left + IMAGE_SIDE, top + IMAGE_SIDE)))


# --- patches of planar meshes


class Patches(NamedTuple):
    """Parts of planar meshes. Places are positions in the plane, in mean vertex radii."""

    logs: Complex64[Any, "B K S"]  # of sample points in the one-ring of each vertex
    places: Complex64[Any, "B K S"]  # of the same points
    queries: Queries  # [B, Q, …] in the faces between the patch's vertices, which are numbered from 0
    query_places: Complex64[Any, "B Q"]


def bank_of_patches(samples: int, queries: int, seed: int) -> Patches:
    """Patches of planar triangulations, from nearly regular to highly irregular ones."""
    rng = np.random.default_rng(seed)
    bank = []
    for irregularity in np.linspace(0, 0.7, SHEETS):
        sheet = planar(SHEET_VERTICES, (1.0, 1.0), rng, irregularity)
        points, logs = points_in_rings(sheet, samples, rng)
        frames = tangent_frames(sheet)
        places = _places(sheet, points, frames.radius).reshape(logs.shape)
        for center in rng.choice(SHEET_VERTICES, PATCHES, replace=False):
            bank.append(_patch(sheet, frames, int(center), logs, places, queries, rng))
    return jax.tree.map(lambda *parts: np.stack(parts), *bank)


def _patch(
    sheet: Triangulation,
    frames: TangentFrames,
    center: int,
    logs: Any,
    places: Any,
    queries: int,
    rng: Rng,
) -> Patches:
    """The vertices nearest to `center`, and uniform points in the faces whose corners are all among them."""
    distances = np.linalg.norm(sheet.vertices - sheet.vertices[center], axis=1)
    chosen = np.argsort(distances)[:PATCH_VERTICES]
    numbers = np.full(len(distances), -1, np.int32)
    numbers[chosen] = np.arange(PATCH_VERTICES)
    between = np.flatnonzero((numbers[sheet.faces] >= 0).all(1))
    points = _points_in_faces(sheet, between, queries, rng)
    in_patch = queries_at(points, sheet, frames)
    origin = places[center].mean()
    return Patches(
        logs[chosen],
        (places[chosen] - origin).astype(np.complex64),
        in_patch._replace(vertices=numbers[in_patch.vertices]),
        (_places(sheet, points, frames.radius) - origin).astype(np.complex64),
    )


def _points_in_faces(sheet: Triangulation, faces: Any, count: int, rng: Rng) -> SurfacePoints:
    cumulated = np.cumsum(length_of(area_normals(sheet.vertices, sheet.faces[faces])))
    strata = (np.arange(count) + rng.random(count)) / count * cumulated[-1]
    picked = faces[np.minimum(np.searchsorted(cumulated, strata), len(faces) - 1)]
    return SurfacePoints(picked, rng.dirichlet(np.ones(3), count))


def _places(sheet: Triangulation, points: SurfacePoints, radius: float) -> Any:
    where = positions(sheet.vertices, sheet.faces, points)
    return (where[:, 0] + 1j * where[:, 1]) / radius


# --- batches


class PatchBatch(NamedTuple):
    """Patches with their colours, as one mesh with many components."""

    rings: RingSamples  # [V, S]
    queries: Queries  # [P, 3]
    colors: Float[Any, "P 3"]  # at the queries


class Placement(NamedTuple):
    """Where patches lie on images, and how their colours change (`_recolored`)."""

    image: Int[Array, "B"]
    scale: Float[Array, "B"]  # pixels per mean vertex radius
    turn: Complex[Array, "B"]  # rotation
    stretch: Float[Array, "B"]  # factor along `grain`, and its inverse across: areas are preserved
    grain: Complex[Array, "B"]  # unit direction
    corner: Float[Array, "B 2"]  # position on the image, from 0 to 1 of the free range
    channels: Int[Array, "B 3"]  # permutation of RGB
    contrast: Float[Array, "B"]
    target: Float[Array, "B 3"]  # added to the mean colour
    painted: Float[Array, "B"]  # 1 for a recoloured patch, else 0


def random_placement(key: Array, count: int, images: int, config: Images) -> Placement:
    """Random placements. Half of them keep the photograph's colours; the others get the range of print and
    paint: channels permuted, contrast up to ×3 and also negative, the mean shifted, and clipped to [0, 1]."""
    keys = iter(jax.random.split(key, 11))

    def uniform(low: float, high: float, *shape: int) -> Array:
        return jax.random.uniform(next(keys), (count, *shape), minval=low, maxval=high)

    return Placement(
        image=jax.random.randint(next(keys), (count,), 0, images),
        scale=jnp.exp(uniform(math.log(config.smallest), math.log(config.largest))),
        turn=jnp.exp(1j * uniform(0.0, 2 * np.pi)),
        stretch=jnp.exp(0.075 * jax.random.normal(next(keys), (count,))),
        grain=jnp.exp(1j * uniform(0.0, np.pi)),
        corner=uniform(0.0, 1.0, 2),
        channels=jnp.argsort(uniform(0.0, 1.0, 3), -1),
        contrast=jnp.exp(uniform(-0.7, 1.1)) * jnp.where(uniform(0.0, 1.0) < 0.25, -1.0, 1.0),
        target=0.35 * jax.random.normal(next(keys), (count, 3)),
        painted=1.0 * (uniform(0.0, 1.0) < 0.5),
    )


def colors_at(
    images: UInt8[Array, "N H W 3"], placement: Placement, *places: Complex[Array, "B ..."]
) -> tuple[Float[Array, "B ... 3"], ...]:
    """Colours in [0, 1] at each patch's places on its image.

    The first `places` determine the extent of a patch, which must fit the image, and its mean colour.
    """
    pixels = [_pixels(placement, where) for where in places]
    size = jnp.array([images.shape[2], images.shape[1]]) - 1.0
    extent = jnp.max(jnp.abs(pixels[0]), axis=tuple(range(1, pixels[0].ndim)))
    extent = jnp.minimum(extent[:, None], size / 2 - 1)
    x, y = (extent + (size - 2 * extent) * placement.corner).T
    read = [bilinear(images, placement.image, _like(x, p) + p.real, _like(y, p) + p.imag) for p in pixels]
    level = jnp.mean(read[0], axis=tuple(range(1, read[0].ndim)))
    return tuple(_recolored(placement, level, colors) for colors in read)


def _pixels(placement: Placement, places: Complex[Array, "B *P"]) -> Complex[Array, "B *P"]:
    along = places * _like(jnp.conj(placement.grain), places)
    stretch = _like(placement.stretch, places)
    squeezed = jax.lax.complex(along.real * stretch, along.imag / stretch)
    return squeezed * _like(placement.grain * placement.turn * placement.scale, places)


def _recolored(
    placement: Placement, level: Float[Array, "B"], colors: Float[Array, "B *P 3"]
) -> Float[Array, "B *P 3"]:
    mixed = jnp.take_along_axis(colors, _like(placement.channels, colors), -1)
    target = jnp.clip(level[:, None] + placement.target, 0, 1)
    new = _like(target, colors) + _like(placement.contrast, colors) * (mixed - _like(level, colors))
    return jnp.where(_like(placement.painted, colors) > 0, jnp.clip(new, 0, 1), colors)


def _like(x: Array, y: Array) -> Array:
    """One value (or colour) per patch, reshaped to broadcast against an array of its points."""
    return x.reshape(x.shape[:1] + (1,) * (y.ndim - x.ndim) + x.shape[1:])


def bilinear(
    images: UInt8[Array, "N H W 3"], image: Int[Array, "B"], x: Float[Array, "B *P"], y: Float[Array, "B *P"]
) -> Float[Array, "B *P 3"]:
    """Colours in [0, 1] at pixel positions in each patch's image, clamped at its border."""
    height, width = images.shape[1:3]
    x, y = jnp.clip(x, 0, width - 1.001), jnp.clip(y, 0, height - 1.001)
    column, row, which = x.astype(jnp.int32), y.astype(jnp.int32), _like(image, x)
    right, down = (x - column)[..., None], (y - row)[..., None]

    def at(rows: Array, columns: Array) -> Array:
        return images[which, rows, columns].astype(jnp.float32)

    top = at(row, column) * (1 - right) + at(row, column + 1) * right
    bottom = at(row + 1, column) * (1 - right) + at(row + 1, column + 1) * right
    return (top * (1 - down) + bottom * down) / 255


def one_mesh(patches: Patches, ring_colors: Array, query_colors: Array) -> PatchBatch:
    """The patches as one mesh: the vertices of each are numbered after those of the patches before it."""
    count, vertices = patches.logs.shape[:2]
    first = vertices * jnp.arange(count, dtype=jnp.int32)[:, None, None]
    queries = patches.queries._replace(vertices=patches.queries.vertices + first)
    flat = partial(jax.tree.map, lambda a: a.reshape(-1, *a.shape[2:]))
    return PatchBatch(flat(RingSamples(patches.logs, ring_colors)), flat(queries), flat(query_colors))


class ImagePatches:
    """Batches of patches on the images of a folder and on printed pages; batch `step` is always the same."""

    def __init__(self, config: Images, model: FLVAE, batch: int) -> None:
        photos = load_images(Path(config.folder))
        prints = printed_pages(round(config.prints * len(photos)), IMAGE_SIDE, config.seed)
        images: Any = np.concatenate([photos, prints])
        self.digest = hashlib.sha256(images).hexdigest()
        self.config, self.batch = config, batch
        self.images = jnp.asarray(images)
        bank = bank_of_patches(model.samples, config.queries * PATCH_VERTICES, config.seed)
        self.bank: Patches = jax.tree.map(jnp.asarray, bank)

    def __call__(self, step: int) -> PatchBatch:
        return _batch(self.bank, self.images, self.key(step), self.batch, self.config)

    def placement(self, step: int) -> Placement:
        """The placements of batch `step`, for callers that read colours at other points."""
        return random_placement(self.key(step), self.batch, len(self.images), self.config)

    def key(self, step: int) -> Array:
        """The random key of batch `step`."""
        return jax.random.fold_in(jax.random.key(self.config.seed), step)


@partial(jax.jit, static_argnums=(3, 4))
def _batch(bank: Patches, images: Array, key: Array, count: int, config: Images) -> PatchBatch:
    chosen = jax.random.randint(jax.random.fold_in(key, 1), (count,), 0, len(bank.logs))
    patches = jax.tree.map(lambda a: a[chosen], bank)
    placement = random_placement(key, count, len(images), config)
    return one_mesh(patches, *colors_at(images, placement, patches.places, patches.query_places))


def first_rings(patches: ImagePatches, start: int = 0, count: int = 16_384) -> RingSamples:
    """At least `count` one-rings of the batches from `start` on, to fit principal components to."""
    batches = range(start, start - (-count // (patches.batch * PATCH_VERTICES)))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *(patches(step).rings for step in batches))
