"""Planar meshes laid over images, made as they are needed: what the field-latent VAE is trained on.

A bank of patches (neighbouring vertices of a random triangulation, points of their one-rings, and points of
the faces between them) is built once, by the functions that sample real meshes. A batch lays some of them on
images, each at its own scale, direction and stretch, and exchanges the colours of half of them. It is made
by one compiled function, on the device that trains.
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

from flx.config import FLVAE, Images
from flx.geometry.arrays import area_normals, length_of
from flx.geometry.copies import points_in_rings, queries_at
from flx.geometry.remesh.planar import planar
from flx.geometry.sampling import positions
from flx.geometry.tangent import TangentFrames, tangent_frames
from flx.pipeline.printed_pages import printed_pages
from flx.types import Queries, RingSamples, SurfacePoints, Triangulation

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
SIDE = 512  # pixels of an image
VERTICES = 24  # of a patch
SHEETS, SHEET_VERTICES, PATCHES = 24, 600, 64  # triangulations of the bank, their vertices, patches of each


# --- images


def load_images(folder: Path) -> UInt8[Any, "N 512 512 3"]:
    """Every image below the folder as a centred crop of 512² pixels.

    Raises ValueError where the folder holds no image.
    """
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES)
    if not paths:
        raise ValueError(
            f"{folder} holds no images ({' '.join(SUFFIXES)}); name a folder with --images.folder"
        )
    return np.stack([centred_crop(Image.open(path)) for path in paths])


def centred_crop(image: Image.Image, size: int = SIDE) -> UInt8[Any, "512 512 3"]:
    """The middle of the image; one that is too small is enlarged first."""
    image = image.convert("RGB")
    scale = size / min(image.size)
    if scale > 1:
        width, height = (max(size, round(scale * n)) for n in image.size)
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    left, top = (image.width - size) // 2, (image.height - size) // 2
    return np.asarray(image.crop((left, top, left + size, top + size)))


# --- patches of planar meshes


class Patches(NamedTuple):
    """Parts of planar meshes. Places are where points lie in the plane, in mean vertex radii."""

    logs: Complex64[Any, "B K S"]  # of the points of each vertex's one-ring
    places: Complex64[Any, "B K S"]
    queries: Queries  # [B, Q, …] in the faces between the patch's vertices, which they number from 0
    query_places: Complex64[Any, "B Q"]


def bank_of_patches(samples: int, queries: int, seed: int) -> Patches:
    """Patches of triangulations from even to wholly random."""
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
    rng: np.random.Generator,
) -> Patches:
    """The vertices nearest to one of them, and points uniform in the faces that lie wholly between them."""
    distances = np.linalg.norm(sheet.vertices - sheet.vertices[center], axis=1)
    chosen = np.argsort(distances)[:VERTICES]
    numbers = np.full(len(distances), -1, np.int32)
    numbers[chosen] = np.arange(VERTICES)
    between = np.flatnonzero((numbers[sheet.faces] >= 0).all(1))
    points = _points_in_faces(sheet, between, queries, rng)
    asked = queries_at(points, sheet, frames)
    origin = places[center].mean()
    return Patches(
        logs[chosen],
        (places[chosen] - origin).astype(np.complex64),
        asked._replace(vertices=numbers[asked.vertices]),
        (_places(sheet, points, frames.radius) - origin).astype(np.complex64),
    )


def _points_in_faces(sheet: Triangulation, faces: Any, count: int, rng: np.random.Generator) -> SurfacePoints:
    cumulated = np.cumsum(length_of(area_normals(sheet.vertices, sheet.faces[faces])))
    strata = (np.arange(count) + rng.random(count)) / count * cumulated[-1]
    picked = faces[np.minimum(np.searchsorted(cumulated, strata), len(faces) - 1)]
    return SurfacePoints(picked, rng.dirichlet(np.ones(3), count))


def _places(sheet: Triangulation, points: SurfacePoints, radius: float) -> Any:
    where = positions(sheet.vertices, sheet.faces, points)
    return (where[:, 0] + 1j * where[:, 1]) / radius


# --- batches


class PatchBatch(NamedTuple):
    """Patches with their colours, as one mesh of many parts."""

    rings: RingSamples  # [V, S]
    queries: Queries  # [P, 3]
    colors: Float[Any, "P 3"]  # at the queries


class Lay(NamedTuple):
    """How points of the plane come to lie on images, and what becomes of the colours found there."""

    image: Int[Array, "B"]
    scale: Float[Array, "B"]  # pixels in a mean vertex radius
    turn: Complex[Array, "B"]
    stretch: Float[Array, "B"]  # along `grain`, and its inverse across: areas stay
    grain: Complex[Array, "B"]
    corner: Float[Array, "B 2"]  # where on the image, from 0 to 1 of the room there is
    channels: Int[Array, "B 3"]
    contrast: Float[Array, "B"]
    target: Float[Array, "B 3"]  # added to the mean colour
    painted: Float[Array, "B"]  # 1 where colours are exchanged, else 0


def random_lay(key: Array, count: int, images: int, config: Images) -> Lay:
    """Half keep the photograph's colours; the others get the range of print and paint: channels exchanged,
    contrast up to ×3 and also negative, about a random level; what leaves [0, 1] is clipped there."""
    keys = iter(jax.random.split(key, 11))

    def uniform(low: float, high: float, *shape: int) -> Array:
        return jax.random.uniform(next(keys), (count, *shape), minval=low, maxval=high)

    return Lay(
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
    images: UInt8[Array, "N H W 3"], lay: Lay, *places: Complex[Array, "B ..."]
) -> tuple[Float[Array, "B ... 3"], ...]:
    """Colours in [0, 1] of each patch's places, laid on its image. The first places set reach and level."""
    found = [_pixels(lay, where) for where in places]
    room = jnp.array([images.shape[2], images.shape[1]]) - 1.0
    reach = jnp.max(jnp.abs(found[0]), axis=tuple(range(1, found[0].ndim)))
    reach = jnp.minimum(reach[:, None], room / 2 - 1)
    x, y = (reach + (room - 2 * reach) * lay.corner).T
    read = [bilinear(images, lay.image, _like(x, p) + p.real, _like(y, p) + p.imag) for p in found]
    level = jnp.mean(read[0], axis=tuple(range(1, read[0].ndim)))
    return tuple(_recolored(lay, level, colors) for colors in read)


def _pixels(lay: Lay, places: Complex[Array, "B *P"]) -> Complex[Array, "B *P"]:
    along = places * _like(jnp.conj(lay.grain), places)
    stretch = _like(lay.stretch, places)
    squeezed = jax.lax.complex(along.real * stretch, along.imag / stretch)
    return squeezed * _like(lay.grain * lay.turn * lay.scale, places)


def _recolored(lay: Lay, level: Float[Array, "B"], colors: Float[Array, "B *P 3"]) -> Float[Array, "B *P 3"]:
    mixed = jnp.take_along_axis(colors, _like(lay.channels, colors), -1)
    target = jnp.clip(level[:, None] + lay.target, 0, 1)
    new = _like(target, colors) + _like(lay.contrast, colors) * (mixed - _like(level, colors))
    return jnp.where(_like(lay.painted, colors) > 0, jnp.clip(new, 0, 1), colors)


def _like(x: Array, y: Array) -> Array:
    """One value (or colour) of each patch beside an array of its points."""
    middle = (1,) * (y.ndim - x.ndim)
    return x.reshape(x.shape[:1] + middle + x.shape[1:])


def bilinear(
    images: UInt8[Array, "N H W 3"], image: Int[Array, "B"], x: Float[Array, "B *P"], y: Float[Array, "B *P"]
) -> Float[Array, "B *P 3"]:
    """Colours in [0, 1] at pixel positions inside each patch's image, clamped at its border."""
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
    """The patches side by side: each numbers its vertices after those of the patches before it."""
    count, vertices = patches.logs.shape[:2]
    first = vertices * jnp.arange(count, dtype=jnp.int32)[:, None, None]
    queries = patches.queries._replace(vertices=patches.queries.vertices + first)
    flat = partial(jax.tree.map, lambda a: a.reshape(-1, *a.shape[2:]))
    return PatchBatch(flat(RingSamples(patches.logs, ring_colors)), flat(queries), flat(query_colors))


class ImagePatches:
    """Batches of patches over images of a folder and printed pages; batch `step` is always the same."""

    def __init__(self, config: Images, model: FLVAE, batch: int) -> None:
        images: Any = load_images(Path(config.folder))
        prints = printed_pages(round(config.prints * len(images)), SIDE, config.seed)
        images = np.concatenate([images, prints]) if len(prints) else images
        self.digest = hashlib.sha256(images).hexdigest()
        self.config, self.batch = config, batch
        self.images = jnp.asarray(images)
        bank = bank_of_patches(model.samples, config.queries * VERTICES, config.seed)
        self.bank: Patches = jax.tree.map(jnp.asarray, bank)

    def __call__(self, step: int) -> PatchBatch:
        return _batch(self.bank, self.images, self.key(step), self.batch, self.config)

    def lay(self, step: int) -> Lay:
        """Where batch `step` lies, for who reads other points there."""
        return random_lay(self.key(step), self.batch, len(self.images), self.config)

    def key(self, step: int) -> Array:
        """The randomness of batch `step`."""
        return jax.random.fold_in(jax.random.key(self.config.seed), step)


@partial(jax.jit, static_argnums=(3, 4))
def _batch(bank: Patches, images: Array, key: Array, count: int, config: Images) -> PatchBatch:
    chosen = jax.random.randint(jax.random.fold_in(key, 1), (count,), 0, len(bank.logs))
    patches = jax.tree.map(lambda a: a[chosen], bank)
    lay = random_lay(key, count, len(images), config)
    return one_mesh(patches, *colors_at(images, lay, patches.places, patches.query_places))


def first_rings(patches: ImagePatches, start: int = 0, count: int = 16_384) -> RingSamples:
    """At least `count` one-rings of the batches from `start` on: what principal components are taken from."""
    batches = range(start, start - (-count // (patches.batch * VERTICES)))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *(patches(step).rings for step in batches))
