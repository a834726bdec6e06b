"""Laws of the generator: one file that is whole or refused, and holds all that sampling needs."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.generators import ball_generator
from helpers.surfaces import icosphere
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open

from flx.config import FLDM
from flx.fields.algebra import tangent_noise
from flx.geometry.tables import mesh_tables
from flx.models.denoiser.depth import complete
from flx.pipeline.codec import load_codec
from flx.pipeline.generator import (
    Generator,
    Home,
    read_generator,
    save_generator,
)
from flx.pipeline.tensors import save_tensors

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def file(generator, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("generator") / "generator.safetensors"
    save_generator(path, generator)
    return path


def test_what_was_saved_samples_the_same_bits(generator, file):
    read = read_generator(file)
    for sampler in ("ddim", "dpm", "ancestral"):
        of_one = generator.sample(jax.random.key(3), steps=5, sampler=sampler)
        np.testing.assert_array_equal(read.sample(jax.random.key(3), steps=5, sampler=sampler), of_one)
        assert of_one.shape == (162, 8) and np.isfinite(of_one).all() and of_one.std() > 0.1
        assert np.abs(of_one - generator.sample(jax.random.key(4), steps=5, sampler=sampler)).max() > 0.1
    assert read.experiment.model == generator.experiment.model and read.step == 7
    assert read.asset.digest == generator.source.digest == read.source.digest


def test_a_sample_is_scaled_back_to_codes(generator):
    """z · scale⁻¹ + shift, number by number: doubling the scale halves what is left without the shift."""
    key, scaling = jax.random.key(3), generator.scaling
    doubled = dataclasses.replace(generator, scaling=scaling._replace(scale=2 * scaling.scale))
    once, half = (g.sample(key, steps=5) - scaling.shift for g in (generator, doubled))
    np.testing.assert_allclose(half, once / 2, rtol=1e-4, atol=1e-5)


def test_it_samples_on_other_copies_and_calls_its_hook(generator):
    sphere = icosphere(1)
    z = generator.sample(jax.random.key(0), Home(sphere, mesh_tables(sphere)), steps=4)
    assert z.shape == (42, 8)
    still = generator.sample(jax.random.key(0), steps=4, hook=zeros)
    np.testing.assert_allclose(still, np.tile(generator.scaling.shift, (162, 1)), atol=1e-6)


def zeros(z, s, key):
    return 0 * z


def test_any_function_that_finds_noise_is_a_generator(generator):
    """The seam for generators that nobody trained: here the exact answer for one point."""
    exact = dataclasses.replace(generator, denoise=OnePoint(), params=jnp.float32(0.5))
    alphas = generator.alphas
    assert alphas[-1] > 0.5  # twenty steps of the paper's betas: the start is far from the data
    z = exact.sample(jax.random.key(0), steps=20)
    np.testing.assert_allclose(
        z, generator.scaling.to_latents(np.full((162, 8), 0.5, np.complex64)), atol=1e-3
    )


class Nothing:
    """Finds no noise."""

    def __call__(self, params, tables, z, t):
        return 0 * z


@pytest.mark.parametrize("strength", [0.05, 0.5, 0.95])
def test_strength_is_how_far_samples_go_from_codes(generator, strength):
    """Where no noise is found, z_t/√α_t is left: `near` and noise of variance (1 − α_t)/α_t."""
    idle, near = dataclasses.replace(generator, denoise=Nothing()), np.full((162, 8), 3 + 1j, np.complex64)
    z = idle.sample(jax.random.key(1), steps=20, sampler="ddim", near=near, strength=strength)
    away = generator.scaling.to_diffusion(z) - generator.scaling.to_diffusion(near)
    alpha = generator.alphas[round(20 * strength)]
    assert np.mean(np.abs(away) ** 2) / 2 == pytest.approx((1 - alpha) / alpha, rel=0.1)


def test_at_full_strength_the_start_is_forgotten(generator):
    plain = generator.sample(jax.random.key(1), steps=5)
    near = np.full((162, 8), 9, np.complex64)
    np.testing.assert_array_equal(generator.sample(jax.random.key(1), steps=5, near=near), plain)
    for strength in (0.0, -1.0, 1.5, float("nan")):
        with pytest.raises(ValueError, match=r"strength is .*more than 0 and at most 1"):
            generator.sample(jax.random.key(1), near=near, strength=strength)


class OnePoint:
    def __call__(self, point, tables, z, t):
        alpha = jnp.asarray(np.cumprod(np.r_[1, 1 - np.linspace(1e-4, 2e-2, 20)]), jnp.float32)[t.astype(int)]
        return (z - jnp.sqrt(alpha) * point) / jnp.sqrt(1 - alpha)


def test_no_path_of_its_maker_is_in_the_file(file):
    content = file.read_bytes()
    assert b"ball.ply" in content and b"anna" not in content and b"secret" not in content


@given(data=st.data())
@settings(max_examples=40)
def test_a_flipped_bit_is_never_loaded(file, tmp_path_factory, data):
    content = bytearray(file.read_bytes())
    place = data.draw(st.one_of(st.integers(0, 4000), st.integers(0, len(content) - 1)), "place")
    content[place] ^= 1 << data.draw(st.integers(0, 7), "bit")
    flipped = tmp_path_factory.mktemp("flipped") / "generator.safetensors"
    flipped.write_bytes(content)
    with pytest.raises(ValueError, match="cannot be used as a generator") as refusal:
        read_generator(flipped)
    assert "\n" not in str(refusal.value)


def test_a_generator_knows_what_is_damaged_when_it_was_saved(generator, tmp_path):
    files = generator.source.files | {"fill/mask.png": b"as it is"}
    surface = dataclasses.replace(generator.experiment.surface, fill="/home/anna/mask.png")
    damaged = dataclasses.replace(
        generator,
        source=generator.source._replace(fill="fill/mask.png", files=files),
        experiment=dataclasses.replace(generator.experiment, surface=surface),
    )
    save_generator(tmp_path / "a.safetensors", damaged)
    read = read_generator(tmp_path / "a.safetensors")
    assert read.source.fill == "fill/mask.png" and read.experiment.surface.fill == "mask.png"
    assert read.source.files == files and generator.intact is None


@pytest.mark.parametrize("length", [0, 7, 100, -1])
def test_a_torn_file_is_refused(file, tmp_path, length):
    torn = tmp_path / "generator.safetensors"
    torn.write_bytes(file.read_bytes()[:length])
    with pytest.raises(ValueError, match="cannot be used as a generator"):
        read_generator(torn)


@pytest.mark.parametrize(("part", "last"), [("network", "/size"), ("codec", "")])
def test_a_network_of_another_version_is_refused(file, tmp_path, part, last):
    """One parameter is lacking, or has another shape; the rest of the file is sound."""
    with safe_open(file, "numpy") as content:
        text = content.metadata()["generator"].partition(" ")[2]
        tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    other = tmp_path / "generator.safetensors"

    def read(tensors: dict[str, np.ndarray]) -> Generator:
        save_tensors(other, tensors, "generator", text)
        return read_generator(other)

    assert read(tensors).step == 7
    place = min(name for name in tensors if name.startswith(f"{part}/") and name.endswith(last))
    for spoilt in (
        {name: tensor for name, tensor in tensors.items() if name != place},
        tensors | {place: tensors[place][..., :-1].copy()},
        tensors | {place + "2": tensors[place]},
    ):
        with pytest.raises(ValueError, match=f"generator .{place}2? differs.*another version") as refusal:
            read(spoilt)
        assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("name", ["../evil.ply", "/tmp/flx-evil.ply", "files/../../evil.ply"])
def test_no_file_of_it_lands_outside_of_its_folder(generator, tmp_path, name):
    source = generator.source._replace(files={**generator.source.files, name: b"evil"})
    save_generator(tmp_path / "evil.safetensors", dataclasses.replace(generator, source=source))
    read = read_generator(tmp_path / "evil.safetensors")
    with pytest.raises(ValueError, match="outside"):
        _ = read.asset
    assert not Path("/tmp/flx-evil.ply").exists()


def test_loading_and_sampling_import_no_optimiser(file):
    script = (
        "import sys, jax; from flx.training.load import load_generator\n"
        "load_generator(sys.argv[1]).sample(jax.random.key(0), steps=2)\n"
        "print([m for m in ('optax', 'orbax', 'tensorboardX') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(file)], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_what_a_config_leaves_open_follows_from_the_codec_and_what_contradicts_it_is_refused():
    codec = load_codec().config
    model = complete(FLDM(), codec, 30_000)
    assert (model.network, model.latents, model.invariants, model.blocks) == ("mixed", 8, 3, (2, 4, 4))
    vectors = dataclasses.replace(codec, encoder="transformer", invariants=0)
    assert complete(FLDM(), vectors, 2500).network == "vectors"
    assert complete(FLDM(network="mixed", blocks=(1, 2, 3)), vectors, 2500).blocks == (1, 2, 3)
    for wrong, named in (
        (FLDM(latents=5), "latents is 5"),
        (FLDM(invariants=0), "invariants is 0"),
        (FLDM(network="vectors"), "--model.network mixed"),
    ):
        with pytest.raises(ValueError, match=named):
            complete(wrong, codec, 2500)


def test_noise_is_what_sampling_starts_from(generator):
    """Without a step the codes are tangent noise of the key's first half, scaled back."""
    nothing = dataclasses.replace(generator, denoise=Silent(), alphas=np.array([1.0, 1.0 - 1e-9]))
    of_start, _ = jax.random.split(jax.random.key(9))
    noise = generator.scaling.to_latents(np.asarray(tangent_noise(of_start, (162, 8))))
    np.testing.assert_allclose(nothing.sample(jax.random.key(9), steps=1), noise, rtol=1e-4, atol=1e-4)


class Silent:
    def __call__(self, params, tables, z, t):
        return 0 * z


@pytest.mark.parametrize("part", ["labels", "fill"])
def test_what_leads_out_of_the_files_of_a_generator_is_refused(tmp_path, part):
    made = ball_generator(tmp_path, labelled=True)
    strange = dataclasses.replace(made, source=made.source._replace(**{part: "../../etc/hosts"}))
    with pytest.raises(ValueError, match="outside"):
        _ = strange.labelled if part == "labels" else strange.intact
