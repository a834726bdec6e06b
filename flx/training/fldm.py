"""Train a field-latent diffusion model on the triangulated copies of one mesh."""

import hashlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from tqdm import tqdm

from flx.config import FLDM, FLDMExperiment
from flx.fields import diffusion
from flx.fields.algebra import squared_modulus, tangent_noise
from flx.fields.diffusion import latent_scaling
from flx.geometry.tables import stack
from flx.models.denoiser.depth import blocks_for, reach
from flx.models.denoiser.mixed import MixedDenoiser
from flx.models.denoiser.vectors import Denoiser, denoise, schedule
from flx.pipeline.codec import Codec, load_codec
from flx.pipeline.copies import Cache, Prepared, open_cache, prepare
from flx.training.loop import LossFn, train
from flx.training.run import Run, open_run
from flx.training.run_asset import keep, read_source
from flx.types import MeshTables


class MeshBatch(NamedTuple):
    """Copies of one mesh and their scaled latents."""

    tables: MeshTables
    latents: Any  # Complex64 [B, V, D]


def learn_fldm(experiment: FLDMExperiment, root: Path) -> Run:
    """Prepare the asset (cached), then train a field-latent diffusion model on its copies."""
    surface, config = experiment.surface, experiment.train
    asset = read_source(surface)
    codec = load_codec(experiment.weights)
    fingerprint = hashlib.sha256((asset.digest + codec.digest()).encode()).hexdigest()
    run = open_run(root, experiment, fingerprint)
    asset = keep(asset, run, surface)
    cache = open_cache(run.prepared, asset, surface, codec)
    prepare(cache, asset, surface, codec)
    copies = load_copies(cache, experiment)
    scaling = latent_scaling(np.concatenate([copy.latents for copy in copies]), codec.config.invariants)
    latents = np.stack([scaling.to_diffusion(copy.latents) for copy in copies])
    whole = MeshBatch(stack([copy.tables for copy in copies]), latents)
    network = denoiser(experiment, codec)
    seen = reach(copies[0].tables, network.blocks)
    tqdm.write(
        f"{run.folder}: blocks {network.blocks}, each vertex sees {seen:.1%} of the vertices", file=sys.stderr
    )

    def batches(step: int) -> MeshBatch:
        rng = np.random.default_rng([config.seed, step])
        chosen = rng.choice(len(copies), config.batch, replace=config.batch > len(copies))
        return jax.tree.map(lambda a: a[chosen], whole)

    first = jax.tree.map(lambda a: a[0], whole)
    params = jax.jit(network.init)(jax.random.key(config.seed), first.tables, first.latents, jnp.float32(1))
    train(run, config, params, diffusion_loss(experiment.model, network), batches)
    return run


def load_copies(cache: Cache, experiment: FLDMExperiment) -> list[Prepared]:
    """The prepared copies in the order of their seeds."""
    return [cache.load(experiment.surface.seed + k) for k in range(experiment.surface.copies)]


def denoiser(experiment: FLDMExperiment, codec: Codec) -> Denoiser | MixedDenoiser:
    """The network for this codec, as deep as its vertex count allows where the experiment does not say.

    Raises ValueError where a network of vectors alone is asked for a codec with invariant channels.
    """
    latents, invariants = codec.config.latents, codec.config.invariants
    model = replace(experiment.model, latents=latents, invariants=invariants)
    blocks = model.blocks or blocks_for(experiment.surface.vertices)
    if model.network == "mixed":
        return MixedDenoiser(model, blocks)
    if invariants:
        raise ValueError(
            f"model.network is 'vectors' but {invariants} of the FL-VAE's {latents} channels are invariant; "
            "take --model.network mixed, or --weights of an FL-VAE of vectors alone"
        )
    return Denoiser(model, blocks)


def diffusion_loss(model: FLDM, network: Denoiser | MixedDenoiser) -> LossFn:
    """E ‖ε − ε̂(Z_t, t)‖² at a random t for each copy (paper, eq. 8), per real coordinate: 1 for ε̂ = 0.

    Where velocities are predicted it is their error, ‖v − v̂‖² = ‖ε − ε̂‖² / α_t: of the large structure too,
    which is decided where there is so much noise that ε tells nothing of it.
    """
    alphas = jnp.asarray(schedule(model), jnp.float32)

    def one(params: Any, tables: MeshTables, latents: Array, key: Array) -> Array:
        of_time, of_noise = jax.random.split(key)
        t = jax.random.randint(of_time, (), 1, model.steps + 1)
        noise = tangent_noise(of_noise, latents.shape)
        noisy = diffusion.diffuse(latents, noise, alphas[t])
        predicted = denoise(network, params, tables, noisy, t.astype(jnp.float32))
        errors = jnp.mean(squared_modulus(predicted - noise), -1) / 2
        error = jnp.sum(tables.fine.masses * errors)
        return error / alphas[t] if model.predicts == "velocity" else error

    def loss(params: Any, batch: MeshBatch, key: Array) -> tuple[Array, dict[str, Array]]:
        if batch.latents.shape[0] == 1:  # a batch of one by vmap costs XLA:CPU a quarter more
            tables, latents = jax.tree.map(lambda a: a[0], batch)
            return one(params, tables, latents, key), {}
        keys = jax.random.split(key, batch.latents.shape[0])
        each = jax.vmap(one, (None, 0, 0, 0))(params, batch.tables, batch.latents, keys)
        return jnp.mean(each), {}

    return loss
