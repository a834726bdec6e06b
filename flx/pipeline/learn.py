"""From an experiment to a run: what is learnt, from which batches, by which loss."""

import hashlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex64
from tqdm import tqdm

from flx.config import FLDM, Experiment, FLDMExperiment, FLVAEExperiment
from flx.fields import ddpm
from flx.fields.algebra import squared_modulus, tangent_noise
from flx.mesh.tables import stack
from flx.models import frame
from flx.models.denoiser import Denoiser, blocks_for, denoise, reach, schedule
from flx.models.mixed import MixedDenoiser
from flx.models.vae import FieldLatentVAE, check, flvae_loss
from flx.pipeline.codec import Codec, initial_params, load_codec, save_codec
from flx.pipeline.images import VERTICES, ImagePatches, PatchBatch, first_rings
from flx.pipeline.kept import keep, read_source
from flx.pipeline.prepare import Cache, Prepared, open_cache, prepare
from flx.pipeline.runs import Run, open_run
from flx.pipeline.train import LossFn, train
from flx.types import MeshTables


def learn(experiment: Experiment, root: Path) -> Run:
    """Train what the experiment describes, from where it was left; return its run folder under `root`."""
    if isinstance(experiment, FLVAEExperiment):
        return learn_flvae(experiment, root)
    return learn_fldm(experiment, root)


# --- the field-latent VAE


def learn_flvae(experiment: FLVAEExperiment, root: Path) -> Run:
    """Train a field-latent VAE on a folder of images; the run folder gets `flvae.safetensors`."""
    check(experiment.model)  # before a run folder is made for it
    patches = ImagePatches(experiment.images, experiment.model, experiment.train.batch)
    run = open_run(root, experiment, patches.digest)
    state = train(
        run, experiment.train, starting_params(experiment, patches), image_loss(experiment), patches
    )
    card = {
        "steps": str(experiment.train.steps),
        "rings": str(experiment.train.steps * experiment.train.batch * VERTICES),
        "images": str(len(patches.images)),
        "kl_weight": str(experiment.kl_weight),
    }
    save_codec(run.folder / "flvae.safetensors", Codec(experiment.model, state.ema), card)
    return run


def image_loss(experiment: FLVAEExperiment) -> LossFn:
    """The loss on the colours at a batch's points: of the blend there, or of what each corner says alone."""
    model = FieldLatentVAE(experiment.model)

    def loss(params: Any, batch: PatchBatch, key: Array) -> tuple[Array, dict[str, Array]]:
        answer: Any = model.apply(params, batch.rings, batch.queries, key)
        blended, corners, posterior = answer
        if experiment.learns == "blend":
            return flvae_loss(batch.colors, blended, posterior, experiment.kl_weight)
        return flvae_loss(batch.colors[:, None], corners, posterior, experiment.kl_weight)

    return loss


def starting_params(experiment: FLVAEExperiment, patches: ImagePatches) -> Any:
    """Random parameters; those of the frame codec start from the principal components of real rings."""
    params = initial_params(experiment.model, experiment.train.seed)
    if experiment.model.encoder != "frame":
        return params
    # Batches that no step of the training sees.
    return frame.start_from_principal_components(params, first_rings(patches, experiment.train.steps))


# --- the field-latent diffusion model


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
    scaling = latent_scaling(copies, codec.config.invariants)
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


class Scaling(NamedTuple):
    """Between latents and what is diffused: as large as the noise, of zero mean where they may be.

    Vectors have one scale for both coordinates and no mean that all frames agree on; the two numbers of an
    invariant channel have each their own.
    """

    shift: Complex64[np.ndarray, "D"]
    scale: Complex64[np.ndarray, "D"]  # of the real and of the imaginary part

    def to_diffusion(self, latents: Complex64[np.ndarray, "V D"]) -> Complex64[np.ndarray, "V D"]:
        """Scaled latents."""
        z = latents - self.shift
        return np.real(z) * np.real(self.scale) + 1j * (np.imag(z) * np.imag(self.scale))

    def to_latents(self, z: Complex64[np.ndarray, "V D"]) -> Complex64[np.ndarray, "V D"]:
        """The inverse."""
        return np.real(z) / np.real(self.scale) + 1j * (np.imag(z) / np.imag(self.scale)) + self.shift


def latent_scaling(copies: list[Prepared], invariants: int) -> Scaling:
    """√(π/2) / E|Z_i| for vectors (paper, "Scaling input latents"); mean 0, variance 1 for invariants."""
    latents = np.concatenate([copy.latents for copy in copies])
    vectors, rest = np.split(latents, [latents.shape[1] - invariants], axis=1)
    of_vectors = np.sqrt(np.pi / 2) / np.maximum(np.abs(vectors).mean(0), 1e-6)
    of_rest = 1 / np.maximum(np.real(rest).std(0), 1e-6) + 1j / np.maximum(np.imag(rest).std(0), 1e-6)
    shift = np.concatenate([np.zeros(vectors.shape[1]), rest.mean(0)])
    scale = np.concatenate([of_vectors * (1 + 1j), of_rest])
    return Scaling(shift.astype(np.complex64), scale.astype(np.complex64))


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
        noisy = ddpm.diffuse(latents, noise, alphas[t])
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
