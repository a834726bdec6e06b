"""Train a field-latent diffusion model on the triangulated copies of one mesh."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex64, Complex128, Float32, Int32

from flx.assets.asset import Asset
from flx.assets.formats.files import read_file
from flx.config import FLDM, FLDMExperiment, Surface
from flx.fields import diffusion
from flx.fields.algebra import squared_modulus, tangent_noise
from flx.fields.diffusion import Scaling, emphasized, latent_scaling
from flx.fields.guidance import dropped
from flx.geometry.direction import Direction, carried, field_on
from flx.geometry.labels import LabelMap, labels_on
from flx.geometry.tables import stack
from flx.models.denoiser.depth import complete, reach
from flx.models.denoiser.unet import UNet, denoise, schedule
from flx.pipeline.codec import Codec, load_codec
from flx.pipeline.copies import open_cache, prepare
from flx.pipeline.direction import digest_of_direction, read_direction
from flx.pipeline.generator import (
    Generator,
    Home,
    learnt_generator,
    network_of,
    parameter_shapes,
    save_generator,
)
from flx.pipeline.labels import Labels, in_words, read_labels
from flx.pipeline.masks import Kept, intact_masses, read_damage, without_damage
from flx.stopping import keeping
from flx.training.devices import devices_for
from flx.training.hosts import Host, leader_first
from flx.training.log import say
from flx.training.loop import LossFn, averaged, kept, restore, train
from flx.training.run import Run, open_run
from flx.training.run_asset import (
    direction_in,
    fill_in,
    keep,
    labels_in,
    read_copy,
    read_source,
    source_of,
)
from flx.types import MeshTables


class MeshBatch(NamedTuple):
    """Copies of one mesh, their scaled latents, and what their vertices are like."""

    tables: MeshTables
    latents: Any  # Complex64 [B, V, D]
    times: Any  # Int32 [B], from 1 to T
    labels: Any = None  # Int32 [B, V]
    direction: Any = None  # Complex64 [B, V]
    masses: Any = None  # Float32 [B, V], of vertices in the loss, where some of the texture is damaged
    rows: Any = None  # Int32 [B], numbers of the copies in the whole batch; 0, 1, … unless given


def learn_fldm(
    experiment: FLDMExperiment,
    root: Path,
    workers: int | None = None,
    number: int | None = None,
    host: Host | None = None,
) -> Run:
    """Prepare the asset (cached), then train a field-latent diffusion model on its copies.

    The run folder gets `generator.safetensors` at each checkpoint. `number` devices of each process share a
    batch, as many as can unless given; `host` is this process among those of the training. Raises ValueError
    where the experiment's network does not fit its FL-VAE, and where the devices cannot share a batch, before
    anything is made.
    """
    surface, config, host = experiment.surface, experiment.train, host or Host()
    devices = devices_for(config.batch, config.accumulate, number, host)
    codec = load_codec(experiment.weights)
    asset = read_source(surface)
    labelled = read_labels(Path(surface.labels), asset) if surface.labels else None
    drawn = read_direction(surface.direction, asset) if surface.direction else None
    intact = read_damage(Path(surface.fill), asset) if surface.fill else None
    experiment = completed(experiment, codec, labelled, drawn)
    network = network_of(experiment.model)
    fingerprint = fingerprint_of(asset, codec, surface)
    with leader_first(host, "run"):
        run = open_run(root, experiment, fingerprint) if host.leads else Run(root / experiment.name)
        asset = keep(asset, run, surface) if host.leads else asset
    rules = experiment.model, labelled, drawn, intact, workers
    with leader_first(host, "copies"):
        copies, scaling, home, labels, direction = load_copies(run, asset, surface, codec, *rules)
    keeping(lambda: kept(run))
    source = source_of(run, surface, asset)
    seen = reach(home.tables, network.blocks)
    say(f"{run.folder}: blocks {network.blocks}, each vertex sees {seen:.1%} of the vertices")
    if devices.count > 1:
        say(f"{run.folder}: {config.batch} copies a step on {devices}")
    if labels:
        say(f"{run.folder}: {surface.labels} has {in_words(labels, home.tables)}")
    if direction is not None:
        say(f"{run.folder}: direction {surface.direction}, at {(direction != 0).mean():.1%} of the vertices")

    mine = devices.rows(config.batch)

    def batches(step: int) -> MeshBatch:
        rng = np.random.default_rng([config.seed, step])
        rows = np.arange(config.batch, dtype=np.int32)
        chosen = rng.choice(surface.copies, config.batch, replace=config.batch > surface.copies)[mine]
        tables, means, spreads, *seen = copies.at(chosen)
        if spreads is not None:
            each = (np.random.default_rng([config.seed, step, row]) for row in rows[mine])
            means = np.stack([drawn_codes(*row) for row in zip(means, spreads, each, strict=True)])
        times = draw_times(experiment.model, config.seed, step * config.batch, config.batch)
        return MeshBatch(tables, means, times[mine], *seen, rows=rows[mine])

    def save(step: int, params: Any) -> None:
        parts = scaling, codec, home, source, step, labels, direction
        generator = learnt_generator(experiment, params, *parts)
        save_generator(run.generator, generator)

    first = copies.at(0)
    if first.masses is not None:
        hidden = first.tables.fine.masses[first.masses == 0].sum()
        say(f"{run.folder}: {surface.fill} hides {hidden:.1%} of the surface")
    start = first.tables, first.latents, jnp.float32(1)
    seen = conditions_of(experiment.model, first.labels, first.direction)
    params = jax.jit(network.init)(jax.random.key(config.seed), *start, *seen)
    state = train(run, config, params, diffusion_loss(experiment.model, network), batches, save, devices)
    if host.leads and not run.generator.exists():  # an earlier version trained it
        save(int(state.step), averaged(state, params))
    return run


def completed(
    experiment: FLDMExperiment, codec: Codec, labelled: LabelMap | None, direction: Direction | None
) -> FLDMExperiment:
    """The experiment with the model that is really trained."""
    given = len(labelled.palette) if labelled else 0, int(direction is not None)
    model = complete(experiment.model, codec.config, experiment.surface.vertices, *given)
    return replace(experiment, model=model)


def fingerprint_of(asset: Asset, codec: Codec, surface: Surface) -> str:
    """A digest of all that a run learns from."""
    parts = asset.digest + codec.digest()
    if surface.labels:
        parts += hashlib.sha256(read_file(Path(surface.labels))).hexdigest()
    if surface.direction:
        parts += digest_of_direction(surface.direction)
    if surface.fill:
        parts += "fill" + hashlib.sha256(read_file(Path(surface.fill))).hexdigest()
    return hashlib.sha256(parts.encode()).hexdigest()


def draw_times(model: FLDM, seed: int, first: int, count: int) -> Int32[np.ndarray, "N"]:
    """The steps t of draws first, first + 1, … of a training; evenly spread over each stretch of draws."""
    numbers = diffusion.even_numbers(seed, first, count)
    if model.draws == "lognormal":
        numbers = diffusion.lognormal_steps(schedule(model), numbers)
    return (1 + np.floor(numbers * model.steps)).astype(np.int32)


def drawn_codes(
    means: Complex64[np.ndarray, "*B D"], spreads: Complex64[np.ndarray, "*B D"], rng: np.random.Generator
) -> Complex64[np.ndarray, "*B D"]:
    """z = μ + σ ε: `spreads` are σ of the real part and, as the imaginary part, that of the imaginary one."""
    ahead, up = rng.standard_normal((2, *means.shape), np.float32)
    return (means + np.real(spreads) * ahead + 1j * (np.imag(spreads) * up)).astype(np.complex64)


class Copies(NamedTuple):
    """All copies of one mesh: their scaled latents, and what their vertices are like."""

    tables: MeshTables
    latents: Complex64[np.ndarray, "*B V D"]
    spreads: Complex64[np.ndarray, "*B V D"] | None  # of the latents, where they are drawn; see `drawn_codes`
    labels: Int32[np.ndarray, "*B V"] | None
    direction: Complex64[np.ndarray, "*B V"] | None
    masses: Float32[np.ndarray, "*B V"] | None  # as in `MeshBatch`

    def at(self, chosen: Any) -> "Copies":
        """One of them, or some."""
        return jax.tree.map(lambda a: a[chosen], self)


def load_copies(
    run: Run,
    asset: Asset,
    surface: Surface,
    codec: Codec,
    model: FLDM,
    labelled: LabelMap | None = None,
    direction: Direction | None = None,
    intact: Kept | None = None,
    workers: int | None = None,
) -> tuple[Copies, Scaling, Home, Labels | None, Complex128[np.ndarray, "V"] | None]:
    """All copies of the asset, prepared if need be, and the scaling of their latents.

    The first copy is also returned as it is, with its labels and its direction: the generator samples on it.
    The direction is computed there, and carried to the others.
    """
    learnt, masses = without_damage(asset, intact), None
    cache = open_cache(run.prepared, learnt, surface, codec, model.codes == "draws")
    copies = prepare(cache, learnt, surface, codec, workers)
    latents = [copy.latents for copy in copies]
    every = np.concatenate(latents)
    deviations = [copy.deviations for copy in copies if copy.deviations is not None]
    if deviations:
        both = np.concatenate(deviations) * np.complex64(1 + 1j)
        every = drawn_codes(every, both, np.random.default_rng(surface.seed))
    if intact is not None:
        each = ((copy.triangulation, copy.tables.fine.masses) for copy in copies)
        masses = np.stack([intact_masses(asset.mesh, intact, *copy) for copy in each])
        every = every[masses.ravel() > 0]
    scaling = latent_scaling(every, codec.config.invariants)
    if model.emphasis:
        effects = codec.effects(every, scaling)
        scaling = emphasized(scaling, effects, model.emphasis, codec.config.invariants)
    spreads = np.stack([sigma * scaling.scale for sigma in deviations]) if deviations else None
    scaled = np.stack([scaling.to_diffusion(z) for z in latents])
    home = Home(copies[0].triangulation, copies[0].tables)
    tables = stack([copy.tables for copy in copies])
    numbers = labels = vectors = field = None
    if labelled is not None:
        numbers = np.stack([labels_on(labelled, copy.triangulation) for copy in copies])
        labels = Labels(labelled.palette, numbers[0])
    if direction is not None:
        field = field_on(direction, home.triangulation)
        others = [carried(field, home.triangulation, copy.triangulation) for copy in copies[1:]]
        vectors = np.stack([field, *others]).astype(np.complex64)
    return Copies(tables, scaled, spreads, numbers, vectors, masses), scaling, home, labels, field


def generator_of_checkpoint(run: Run, experiment: FLDMExperiment) -> Generator:
    """The generator of a run without a generator file (from an earlier version): from its newest checkpoint.

    Raises ValueError where the run has no checkpoint yet.
    """
    surface, codec = experiment.surface, load_codec(experiment.weights)
    asset = read_copy(run, surface)
    labelled = read_labels(labels_in(run, surface), asset) if surface.labels else None
    direction = read_direction(said, asset) if (said := direction_in(run, surface)) else None
    intact = read_damage(fill_in(run, surface), asset) if surface.fill else None
    experiment = completed(experiment, codec, labelled, direction)
    rules = experiment.model, labelled, direction, intact
    _, scaling, home, labels, field = load_copies(run, asset, surface, codec, *rules)
    shapes = parameter_shapes(experiment.model, home.tables)
    state = restore(run, experiment.train, shapes)
    source = source_of(run, surface, asset)
    parts = scaling, codec, home, source, int(state.step), labels, field
    return learnt_generator(experiment, averaged(state, shapes), *parts)


def conditions_of(model: FLDM, labels: Any, direction: Any) -> tuple[Array | None, Array | None]:
    """ρ and d as the network takes them, for the labels and the directions of the vertices of a copy."""
    rho = None if labels is None else jax.nn.one_hot(labels, model.conditions)
    return rho, None if direction is None else direction[:, None]


def diffusion_loss(model: FLDM, network: UNet) -> LossFn:
    """E ‖ε − ε̂(Z_t, t)‖² at the t of each copy (paper, eq. 10), per real coordinate: 1 for ε̂ = 0.

    Where velocities are predicted it is their error, ‖v − v̂‖² = ‖ε − ε̂‖² / α_t: it also counts the large
    structure, which is decided where there is so much noise that ε says nothing about it.
    """
    alphas = jnp.asarray(schedule(model), jnp.float32)

    def one(params, copy: MeshBatch, key: Array) -> Array:
        tables, latents, t, labels, direction, masses, row = copy
        key = jax.random.fold_in(key, row)  # whatever device or part of the batch the copy is in
        noise = tangent_noise(key, latents.shape)
        noisy = diffusion.diffuse(latents, noise, alphas[t])
        rho, vectors = conditions_of(model, labels, direction)
        if rho is not None:
            rho = dropped(jax.random.fold_in(key, 1), rho, model.label_dropout)
        if vectors is not None:
            vectors = dropped(jax.random.fold_in(key, 2), vectors, model.direction_dropout)
        predicted = denoise(network, params, tables, noisy, t.astype(jnp.float32), rho, vectors)
        errors = jnp.mean(squared_modulus(predicted - noise), -1) / 2
        error = jnp.sum((tables.fine.masses if masses is None else masses) * errors)
        return error / alphas[t] if model.predicts == "velocity" else error

    def loss(params: Any, batch: MeshBatch, key: Array) -> tuple[Array, dict[str, Array]]:
        count = batch.latents.shape[0]
        if batch.rows is None:
            batch = batch._replace(rows=jnp.arange(count))
        if count == 1:  # a batch of one by vmap costs XLA:CPU a quarter more
            return one(params, jax.tree.map(lambda a: a[0], batch), key), {}
        return jnp.mean(jax.vmap(one, (None, 0, None))(params, batch, key)), {}

    return loss
