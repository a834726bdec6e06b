"""One-rings laid over images, made as they are needed: what the field-latent VAE is trained on.

A pool of planar one-rings is built once; a batch takes rings from it, squeezes and turns them, drops
them on images at a random scale, and reads colours at points drawn uniformly by area.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex128, Float64, UInt8
from PIL import Image

from flx.config import FLVAE, Images
from flx.mesh.triangulations import planar
from flx.types import RingSamples, Triangulation

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")


class RingBatch(NamedTuple):
    """One-rings as the encoder sees them, and other points of the same rings to be predicted."""

    rings: RingSamples
    queries: Any  # Complex64 [B, Q]
    colors: Any  # Float32 [B, Q, 3]


class Fans(NamedTuple):
    """One-rings as fans of triangles around the origin, in mean radii; spare triangles have no area."""

    corners: Complex128[Any, "R T 2"]
    areas: Float64[Any, "R T"]  # cumulated and normalised: the last is 1


def fans(triangulation: Triangulation) -> Fans:
    """The one-rings of a planar triangulation, boundary vertices included."""
    z = triangulation.vertices[:, 0] + 1j * triangulation.vertices[:, 1]
    faces = triangulation.faces
    corners = np.concatenate([np.roll(faces, -k, axis=1) for k in range(3)])
    corners = corners[np.argsort(corners[:, 0], kind="stable")]
    valences = np.bincount(corners[:, 0], minlength=len(z))
    slots = np.arange(len(corners)) - np.repeat(np.cumsum(valences) - valences, valences)
    ring = np.zeros((len(z), valences.max(), 2), complex)
    ring[corners[:, 0], slots] = z[corners[:, 1:]] - z[corners[:, :1]]
    areas = 0.5 * np.imag(np.conj(ring[..., 0]) * ring[..., 1])
    radius = np.sqrt(areas.sum() / 3 / (np.pi * len(z)))
    cumulated = np.cumsum(areas, -1)
    used = valences > 0
    return Fans(ring[used] / radius, (cumulated / np.maximum(cumulated[:, -1:], 1e-300))[used])


def ring_pool(rng: np.random.Generator, meshes: int = 24, vertices: int = 600) -> Fans:
    """Rings of planar triangulations from even to wholly random."""
    pools = [
        fans(planar(vertices, (1.0, 1.0), rng, irregularity=k / (meshes - 1) * 0.7)) for k in range(meshes)
    ]
    slots = max(pool.corners.shape[1] for pool in pools)
    corners = [np.pad(p.corners, ((0, 0), (0, slots - p.corners.shape[1]), (0, 0))) for p in pools]
    areas = [np.pad(p.areas, ((0, 0), (0, slots - p.areas.shape[1])), mode="edge") for p in pools]
    return Fans(np.concatenate(corners), np.concatenate(areas))


def points_in_fans(fan: Fans, count: int, rng: np.random.Generator) -> Complex128[Any, "R count"]:
    """Points uniform by area in each fan, one in each of `count` strata of its area."""
    rings = len(fan.areas)
    strata = (np.arange(count) + rng.random((rings, count))) / count
    triangle = np.minimum((strata[:, :, None] >= fan.areas[:, None, :]).sum(-1), fan.areas.shape[1] - 1)
    a, b = rng.random((2, rings, count))
    fold = a + b > 1
    a, b = np.where(fold, 1 - a, a), np.where(fold, 1 - b, b)
    corners = np.take_along_axis(fan.corners, triangle[..., None], axis=1)
    return a * corners[..., 0] + b * corners[..., 1]


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


def centred_crop(image: Image.Image, size: int = 512) -> UInt8[Any, "512 512 3"]:
    """The middle of the image; one that is too small is enlarged first."""
    image = image.convert("RGB")
    scale = size / min(image.size)
    if scale > 1:
        width, height = (max(size, round(scale * n)) for n in image.size)
        image = image.resize((width, height), Image.Resampling.BICUBIC)
    left, top = (image.width - size) // 2, (image.height - size) // 2
    return np.asarray(image.crop((left, top, left + size, top + size)))


def bilinear(
    images: UInt8[Any, "N H W 3"], which: Any, x: Float64[Any, "R P"], y: Float64[Any, "R P"]
) -> Any:
    """Colours in [0, 1] at pixel positions inside image `which` of each ring, clamped at the border."""
    height, width = images.shape[1:3]
    x, y = np.clip(x, 0, width - 1.001), np.clip(y, 0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - column)[..., None].astype(np.float32), (y - row)[..., None].astype(np.float32)
    flat = images.reshape(-1, 3)
    base = (which[:, None] * height + row) * width + column
    top = flat[base] * (1 - fx) + flat[base + 1] * fx
    bottom = flat[base + width] * (1 - fx) + flat[base + width + 1] * fx
    return ((top * (1 - fy) + bottom * fy) / 255).astype(np.float32)


class ImageRings:
    """Batches of one-rings over the images of a folder; batch `step` is the same in every run."""

    def __init__(self, config: Images, model: FLVAE, batch: int) -> None:
        self.config, self.model, self.batch = config, model, batch
        self.images = load_images(Path(config.folder))
        self.pool = ring_pool(np.random.default_rng(config.seed))

    def __call__(self, step: int) -> RingBatch:
        rng = np.random.default_rng([self.config.seed, step])
        n, samples = self.batch, self.model.samples
        chosen = rng.integers(len(self.pool.areas), size=n)
        fan = Fans(self.pool.corners[chosen], self.pool.areas[chosen])
        logs = np.concatenate(
            [points_in_fans(fan, count, rng) for count in (samples, self.config.queries)], axis=1
        )
        logs = squeeze(logs, np.exp(rng.normal(0, 0.1, (n, 1))), rng.random((n, 1)))
        colors = self.read_colors(logs, rng)
        logs = logs.astype(np.complex64)
        return RingBatch(
            RingSamples(logs[:, :samples], colors[:, :samples]), logs[:, samples:], colors[:, samples:]
        )

    def read_colors(self, logs: Complex128[Any, "R P"], rng: np.random.Generator) -> Any:
        """Lay each ring on a random image at a random place, direction and scale."""
        n = len(logs)
        height, width = self.images.shape[1:3]
        low, high = np.log([self.config.smallest, self.config.largest])
        pixels = np.exp(rng.uniform(low, high, (n, 1))) * np.exp(2j * np.pi * rng.random((n, 1))) * logs
        reach = np.minimum(np.abs(pixels).max(1, keepdims=True), min(height, width) / 2 - 1)
        x = reach + (width - 1 - 2 * reach) * rng.random((n, 1)) + pixels.real
        y = reach + (height - 1 - 2 * reach) * rng.random((n, 1)) + pixels.imag
        colors = bilinear(self.images, rng.integers(len(self.images), size=n), x, y)
        return recolor(colors, rng)


def squeeze(z: Complex128[Any, "R P"], ratio: Any, turn: Any) -> Complex128[Any, "R P"]:
    """Stretch by √ratio along a direction and by its inverse across it: areas stay."""
    direction = np.exp(1j * np.pi * turn)
    along = z * np.conj(direction)
    return (along.real * np.sqrt(ratio) + 1j * along.imag / np.sqrt(ratio)) * direction


def recolor(colors: Any, rng: np.random.Generator) -> Any:
    """Half of the rings keep the photograph's colours; the others get the range of print and paint:
    channels exchanged, contrast up to ×3 about a random level, clipped to near-black and near-white."""
    n = len(colors)
    order = np.argsort(rng.random((n, 1, 3)), axis=-1)
    mixed = np.take_along_axis(colors, np.broadcast_to(order, colors.shape), axis=-1)
    contrast = np.exp(rng.uniform(-0.7, 1.1, (n, 1, 1))) * rng.choice([-1.0, 1.0], (n, 1, 1), p=[0.25, 0.75])
    level = mixed.mean((1, 2), keepdims=True)
    target = np.clip(level + rng.normal(0, 0.35, (n, 1, 3)), 0, 1)
    painted = np.clip(target + contrast * (mixed - level), 0, 1)
    plain = rng.random((n, 1, 1)) < 0.5
    return np.where(plain, colors, painted).astype(np.float32)
