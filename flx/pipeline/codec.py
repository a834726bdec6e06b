"""The field-latent VAE in use: its weights on disk, meshes encoded, points decoded, in bounded memory."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Complex64, Float32

from flx.arguments import check_kind, path_of
from flx.config import FLVAE
from flx.fields.diffusion import Scaling
from flx.models.codec.vae import FieldLatentVAE
from flx.pipeline.tensors import save_tensors
from flx.pipeline.weights import read_weights, weights_file
from flx.types import Queries, RingSamples

RINGS, VERTICES, POINTS = 4096, 65_536, 32_768  # one-rings encoded, codes expanded, points decoded at once


class Codec(NamedTuple):
    """A trained field-latent VAE."""

    config: FLVAE
    params: Any

    def digest(self) -> str:
        """SHA-256 of the weights."""
        return digest_of(self.params)

    def encode(self, rings: RingSamples) -> Complex64[np.ndarray, "V D"]:
        """The mean code of each one-ring, in the frame of its vertex."""
        check_kind("rings", rings, RingSamples, "the rings of a copy, such as flx.triangulate(asset).rings")
        shape, wanted = list(np.shape(rings.logs)), self.config.samples
        if shape[1:] != [wanted]:
            raise ValueError(f"rings have shape {shape}; give {wanted} samples each, as flx.triangulate does")
        return _in_chunks(partial(_mean_code, self.config), self.params, rings, RINGS)

    def posterior(
        self, rings: RingSamples
    ) -> tuple[Complex64[np.ndarray, "V D"], Float32[np.ndarray, "V D"]]:
        """The code of each one-ring as `encode` gives it, its mean, and σ of both its coordinates."""
        return _in_chunks(partial(_mean_and_deviation, self.config), self.params, rings, RINGS)

    def decode(self, queries: Queries, z: Complex64[Any, "V D"]) -> Float32[np.ndarray, "P 3"]:
        """Colours in [0, 1]: what the corners of each face predict, blended."""
        return self.decoder(z)(queries)

    def decoder(self, z: Complex64[Any, "V D"]) -> Callable[[Queries], Float32[np.ndarray, "P 3"]]:
        """`decode` for repeated calls: the work per vertex is done once, here."""
        whole = _in_chunks(partial(_expand, self.config), self.params, z, VERTICES)
        fixed = (self.params, jax.tree.map(jnp.asarray, whole))
        return lambda queries: _in_chunks(partial(_blend, self.config), fixed, queries, POINTS)

    def effects(
        self, latents: Complex64[Any, "N D"], scaling: Scaling, count: int = 512
    ) -> Complex64[np.ndarray, "D"]:
        """What one scaled unit of each channel's real part, and of its imaginary part, does to colours.

        The root mean square over `count` of the codes, at points of the discs around their vertices.
        """
        rng = np.random.default_rng(0)
        scaled = scaling.to_diffusion(rng.choice(np.asarray(latents), count, axis=0))
        logs = np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
        # Three equal corners: what one vertex alone predicts.
        corners, logs = (np.repeat(a[:, None], 3, axis=1) for a in (np.arange(count, dtype=np.int32), logs))
        queries = Queries(corners, logs.astype(np.complex64), np.full((count, 3), 1 / 3, np.float32))

        def effect(unit: Any) -> Any:
            ahead, behind = (self.decode(queries, scaling.to_latents(scaled + s * unit)) for s in (1, -1))
            return np.sqrt(np.mean((ahead - behind) ** 2)) / 2

        units = np.eye(len(scaling.scale), dtype=np.complex64)
        return np.array([effect(unit) + 1j * effect(1j * unit) for unit in units], np.complex64)


def digest_of(params: Any) -> str:
    """SHA-256 of the parameters of a network."""
    leaves = flatten_dict(params).items()
    content = b"".join(repr(k).encode() + np.asarray(v).tobytes() for k, v in sorted(leaves))
    return hashlib.sha256(content).hexdigest()


@partial(jax.jit, static_argnums=0)
def _mean_code(config: FLVAE, params: Any, chunk: RingSamples) -> jax.Array:
    posterior: Any = FieldLatentVAE(config).apply(params, chunk, method="encode")
    return posterior.mean


@partial(jax.jit, static_argnums=0)
def _mean_and_deviation(config: FLVAE, params: Any, chunk: RingSamples) -> tuple[jax.Array, jax.Array]:
    posterior: Any = FieldLatentVAE(config).apply(params, chunk, method="encode")
    return posterior.mean, jnp.exp(posterior.log_sigma)


@partial(jax.jit, static_argnums=0)
def _expand(config: FLVAE, params: Any, z: jax.Array) -> Any:
    return FieldLatentVAE(config).apply(params, z, method="expand")


@partial(jax.jit, static_argnums=0)
def _blend(config: FLVAE, params_expanded: tuple[Any, Any], chunk: Queries) -> jax.Array:
    params, expanded = params_expanded
    colors: Any = FieldLatentVAE(config).apply(params, expanded, chunk, method="blend")
    return jnp.clip(colors, 0, 1)


def save_codec(path: Path, codec: Codec, card: dict[str, str]) -> None:
    """Write weights, configuration and `card` (how they were made) as one safetensors file."""
    tensors = {"/".join(name): np.asarray(a) for name, a in flatten_dict(codec.params["params"]).items()}
    save_tensors(path, tensors, "flvae", json.dumps(asdict(codec.config)), card)


def load_codec(path: str | Path | None = None) -> Codec:
    """A field-latent VAE: the released one, or one that you trained. Nothing in its file is executed.

    Args:
        path: The flvae.safetensors of a run; "vectors" for the shipped FL-VAE whose codes are tangent vectors
            alone, as the paper's network needs them; nothing for the released one.

    The codec's `encode(rings)` gives a code at each vertex, [V, D] complex64, from the rings of a copy: logs
    [V, S] complex64 and colours [V, S, 3]. The released codec has S = 64 and D = 8.

    Raises ValueError where the file is missing, damaged, or not an FL-VAE of this version.

    Example:
        codec = flx.load_codec()
        latents = codec.encode(flx.triangulate(asset, vertices=5000).rings)  # [5000, 8]
    """
    if path is not None:
        path = path_of("path", path, "an FL-VAE file, or nothing for the released one")
    path = weights_file(path)
    config, tensors = read_weights(path)
    if odd := odd_parameter(tensors, jax.eval_shape(lambda: initial_params(config, 0))):
        raise ValueError(f"{path} was made by another version of flx ({odd} differs); use that version")
    return Codec(config, {"params": unflatten_dict(jax.tree.map(jnp.asarray, tensors), "/")})


def odd_parameter(tensors: dict[str, np.ndarray], expected: Any) -> str | None:
    """The first name, if any, at which a file's tensors are not the parameters that a network expects."""
    ours: dict = jax.tree.map(np.shape, tensors)
    wanted: dict = jax.tree.map(np.shape, flatten_dict(expected["params"], sep="/"))
    return min((name for name in ours | wanted if ours.get(name) != wanted.get(name)), default=None)


def initial_params(config: FLVAE, seed: int) -> Any:
    """Random parameters of an FL-VAE."""
    key = jax.random.key(seed)
    logs = jnp.zeros((1, config.samples), jnp.complex64)
    rings = RingSamples(logs, jnp.zeros((1, config.samples, 3), jnp.float32))
    point = Queries(jnp.zeros((1, 3), jnp.int32), logs[:, :3], jnp.full((1, 3), 1 / 3, jnp.float32))
    return FieldLatentVAE(config).init(key, rings, point, key)


def _in_chunks(function: Any, fixed: Any, arrays: Any, size: int) -> Any:
    """Map `function(fixed, chunk)` over the leading axis; the last chunk is padded: one compilation."""
    count = len(jax.tree.leaves(arrays)[0])
    size = min(size, max(count, 1))

    def chunk(start: int) -> Any:
        part = jax.tree.map(lambda a: np.asarray(a[start : start + size]), arrays)
        used = min(size, count - start)
        padded = jax.tree.map(lambda a: np.concatenate([a, a[:1].repeat(size - used, 0)]), part)
        return jax.tree.map(lambda a: np.asarray(a)[:used], function(fixed, padded))

    return jax.tree.map(lambda *parts: np.concatenate(parts), *map(chunk, range(0, count, size)))
