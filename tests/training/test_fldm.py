"""Laws of the loss of diffusion: 0 for who knows the noise, 1 for who says nothing; t drawn evenly."""

from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.files import colored_ball
from helpers.surfaces import square_grid
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest

from flx.config import FLDM, FLDMExperiment, Surface, Train
from flx.fields.algebra import tangent_noise
from flx.geometry.tables import mesh_tables, stack
from flx.models.denoiser.unet import schedule
from flx.models.denoiser.vectors import Denoiser
from flx.pipeline.codec import load_codec
from flx.pipeline.copies import open_cache
from flx.pipeline.generator import read_generator
from flx.training.fldm import MeshBatch, diffusion_loss, draw_times, learn_fldm
from flx.training.loop import TrainState, initial_state
from flx.training.run import Run


class Knowing(Denoiser):
    """Finds what is asked of `DATA` exactly, or says that there is none."""

    says_nothing: bool = False

    @nn.compact
    def __call__(self, tables, z, t, rho=None, direction=None):
        alpha = jnp.asarray(schedule(FLDM()), jnp.float32)[t.astype(int)]
        noise = (z - jnp.sqrt(alpha) * DATA) / jnp.sqrt(1 - alpha)
        velocity = jnp.sqrt(alpha) * noise - jnp.sqrt(1 - alpha) * DATA
        return (not self.says_nothing) * (noise if self.config.predicts == "noise" else velocity)


DATA = tangent_noise(jax.random.key(3), (64, 8))
DATA = DATA * jnp.sqrt(2 / jnp.mean(jnp.abs(DATA) ** 2))  # exactly as large as noise


@pytest.mark.parametrize("predicts", ["velocity", pytest.param("noise", marks=pytest.mark.slow)])
def test_the_loss_is_zero_for_who_knows_the_answer_and_one_for_who_says_nothing(predicts):
    model = FLDM(predicts=predicts)
    times = draw_times(model, 0, 0, 50)
    batch = MeshBatch(stack([mesh_tables(square_grid(8))] * 50), jnp.stack([DATA] * 50), times)
    for says_nothing, expected, close in ((False, 0, 1e-3), (True, 1, 0.05)):
        loss = diffusion_loss(model, Knowing(model, (1, 1, 1), says_nothing))
        found, _ = jax.jit(loss)({}, batch, jax.random.key(0))
        np.testing.assert_allclose(found, expected, atol=close)


class KnowingMost(Knowing):
    """Knows nothing at the first nine vertices."""

    @nn.compact
    def __call__(self, tables, z, t, rho=None, direction=None):
        return super().__call__(tables, z, t).at[:9].add(100)


def test_vertices_without_mass_do_not_count_in_the_loss():
    model, tables = FLDM(), mesh_tables(square_grid(8))
    masses = np.where(np.arange(64) < 9, 0, tables.fine.masses).astype(np.float32)
    loss = jax.jit(diffusion_loss(model, KnowingMost(model, (1, 1, 1))))
    for copies in (1, 3):
        batch = MeshBatch(stack([tables] * copies), jnp.stack([DATA] * copies), np.full(copies, 500))
        blind = batch._replace(masses=np.stack([masses] * copies))
        assert loss({}, batch, jax.random.key(0))[0] > 100
        np.testing.assert_allclose(loss({}, blind, jax.random.key(0))[0], 0, atol=1e-3)


class Mute(Denoiser):
    """Predicts no noise: the loss is that of the noise itself."""

    @nn.compact
    def __call__(self, tables, z, t, rho=None, direction=None):
        return jnp.zeros_like(z)


def test_the_noise_of_a_copy_is_that_of_its_number_whatever_it_is_worked_on_with():
    model, tables, key = FLDM(), mesh_tables(square_grid(8)), jax.random.key(0)
    loss = jax.jit(diffusion_loss(model, Mute(model, (1, 1, 1))))

    def of(*rows: int) -> float:
        count = len(rows)
        batch = MeshBatch(stack([tables] * count), jnp.stack([DATA] * count), np.full(count, 500))
        return float(loss({}, batch._replace(rows=np.array(rows, np.int32)), key)[0])

    alone = [of(row) for row in range(4)]
    assert len({round(value, 5) for value in alone}) == 4
    np.testing.assert_allclose(of(0, 1, 2, 3), np.mean(alone), rtol=1e-5)
    np.testing.assert_allclose(of(3, 1), np.mean([alone[3], alone[1]]), rtol=1e-5)


@given(seed=st.integers(0, 99), first=st.integers(0, 10_000))
def test_any_stretch_of_a_training_draws_all_noise_levels(seed, first):
    """Uniform: each tenth of the schedule has its share. Log-normal: so has each tenth of the normal."""
    uniform = draw_times(FLDM(), seed, first, 100)
    assert uniform.min() >= 1 and uniform.max() <= 1000
    shares = np.bincount((uniform - 1) // 100, minlength=10)
    assert shares.min() >= 8 and shares.max() <= 12
    drawn = draw_times(FLDM(draws="lognormal"), seed, first, 100)
    alphas = schedule(FLDM())[drawn]
    deviates = (np.log((1 - alphas) / alphas) / 2 - 0.2) / 1.1
    assert kstest(deviates, "norm").statistic < 0.05
    np.testing.assert_array_equal(drawn[40:], draw_times(FLDM(draws="lognormal"), seed, first + 40, 60))


@pytest.mark.slow
def test_training_sees_draws_from_the_posterior_where_they_are_asked_for(tmp_path, monkeypatch):
    """z = μ + σ ε: the same for a step, others at each step, as far from the means as σ says."""
    path, feeds = str(colored_ball(tmp_path)), {}

    def notes(run, config, params, loss, batches, *_) -> TrainState:
        feeds[run.folder.name] = batches
        return initial_state(config, params)._replace(step=jnp.int32(1))

    monkeypatch.setattr("flx.training.fldm.train", notes)
    codes: tuple[Literal["means", "draws"], ...] = ("means", "draws")
    for name in codes:
        small = FLDM(channels=4, embedding=8, codes=name)
        surface = Surface(path=path, vertices=100, copies=1)
        learn_fldm(FLDMExperiment(name, surface, Train(batch=1), small), tmp_path / "runs", 1)
    means, draws = (np.stack([feeds[name](step).latents[0] for step in range(60)]) for name in codes)
    assert (means == means[0]).all() and (feeds["draws"](7).latents == draws[7]).all()
    assert len(np.unique(draws[:, 0, 0])) == 60
    run = Run(tmp_path / "runs" / "draws")
    generator = read_generator(run.generator)
    cache = open_cache(run.prepared, generator.asset, Surface(vertices=100), load_codec(), True)
    prepared, scaling = cache.load(0), generator.scaling
    assert prepared.deviations is not None and prepared.deviations.min() > 0
    spreads = prepared.deviations * scaling.scale
    for part in (np.real, np.imag):
        found = (part(draws - scaling.to_diffusion(prepared.latents)) / part(spreads)).ravel()
        assert kstest(found, "norm").statistic < 0.01


class Told(Denoiser):
    """Says what its condition is, everywhere."""

    @nn.compact
    def __call__(self, tables, z, t, rho=None, direction=None):
        assert rho is not None
        return jnp.broadcast_to(rho.sum(0) / len(rho), (len(rho), 8)).astype(jnp.complex64)


class Shown(Denoiser):
    """Says what its direction is, everywhere, in two channels."""

    @nn.compact
    def __call__(self, tables, z, t, rho=None, direction=None):
        assert direction is not None and rho is not None
        told = jnp.broadcast_to(rho.sum(0) / len(rho), (len(rho), 4)).astype(jnp.complex64)
        return jnp.concatenate([told, jnp.broadcast_to(direction, (len(rho), 4))], 1)


def test_a_draw_sees_its_direction_or_none_and_its_labels_for_themselves():
    tables = stack([mesh_tables(square_grid(8))])
    batch = MeshBatch(tables, DATA[None], draw_times(FLDM(), 0, 0, 1), np.full((1, 64), 3, np.int32))
    batch = batch._replace(direction=np.full((1, 64), 1j, np.complex64))

    def values(labels: float, direction: float) -> list[float]:
        dropouts = {"label_dropout": labels, "direction_dropout": direction}
        model = FLDM(conditions=4, directions=1, **dropouts)
        loss = jax.jit(diffusion_loss(model, Shown(model, (1, 1, 1))))
        return [round(float(loss({}, batch, jax.random.key(n))[0]), 4) for n in range(12)]

    ends = {(a, b): values(a, b) for a in (0.0, 1.0) for b in (0.0, 1.0)}
    each = zip(values(0.5, 0.5), *ends.values(), strict=True)
    seen = [row[1:].index(row[0]) for row in each]  # which of the four each draw is
    assert len(set(seen)) == 4


@pytest.mark.parametrize("count", [1, 6])
def test_a_draw_sees_its_labels_or_none_of_them(count):
    """One label of eight: the answer is 1 in its channel, or 0 in all."""
    tables = stack([mesh_tables(square_grid(8))] * count)
    batch = MeshBatch(tables, jnp.stack([DATA] * count), draw_times(FLDM(), 0, 0, count))
    found = {}
    for dropout in (0.0, 0.5, 1.0):
        model = FLDM(conditions=8, label_dropout=dropout)
        loss = jax.jit(diffusion_loss(model, Told(model, (1, 1, 1))))
        labelled = batch._replace(labels=np.full((count, 64), 3, np.int32))
        values = {round(float(loss({}, labelled, jax.random.key(n))[0]), 4) for n in range(12)}
        found[dropout] = values
    told, bare = (np.array(sorted(found[dropout])) for dropout in (0.0, 1.0))
    assert len(told) == len(bare) == 12
    if count == 1:
        assert found[0.5] <= found[0.0] | found[1.0] and found[0.5] & found[0.0] and found[0.5] & found[1.0]
    else:
        assert not found[0.5] <= found[0.0] | found[1.0]  # each copy draws for itself


def test_a_dropout_out_of_range_is_refused():
    for dropout in (-0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"model.label_dropout is"):
            FLDM(label_dropout=dropout)
        with pytest.raises(ValueError, match=r"model.direction_dropout is"):
            FLDM(direction_dropout=dropout)
