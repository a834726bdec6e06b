"""Laws of a trained FL-VAE: read back as it was saved, in any batch, whole or refused."""

import jax
import numpy as np
import pytest
from helpers.codecs import FRAME, TINY, alone, each_config, encode, rings, trained_a_little
from safetensors import safe_open
from safetensors.numpy import save

from flx.fields.diffusion import Scaling
from flx.pipeline.codec import Codec, load_codec, save_codec
from flx.pipeline.tensors import load_tensors
from flx.pipeline.weights import BARYCENTRIC, RELEASED, VECTORS


@pytest.mark.slow
@each_config
def test_a_ring_is_encoded_the_same_in_any_batch_or_chunk(config, monkeypatch):
    model, params = trained_a_little(config)
    r = rings(23)
    whole = encode(model, params, r).mean
    single = encode(model, params, jax.tree.map(lambda a: a[7:8], r)).mean
    np.testing.assert_allclose(single[0], whole[7], atol=1e-4)
    codec = Codec(config, params)
    points = alone(r.logs[:, :4])
    colors = codec.decode(points, whole)
    for name, size in {"RINGS": 5, "VERTICES": 5, "POINTS": 50}.items():
        monkeypatch.setattr(f"flx.pipeline.codec.{name}", size)
    np.testing.assert_allclose(codec.encode(r), whole, atol=1e-4)
    np.testing.assert_allclose(codec.decode(points, whole), colors, atol=1e-5)
    assert np.ptp(colors) > 0.1


@pytest.mark.slow
def test_weights_come_back_as_they_were_saved(tmp_path):
    params = trained_a_little(FRAME)[1]
    save_codec(tmp_path / "w.safetensors", Codec(FRAME, params), {"steps": "0"})
    back = load_codec(tmp_path / "w.safetensors")
    assert back.config == FRAME and back.digest() == Codec(FRAME, params).digest()
    r = rings(5)
    np.testing.assert_array_equal(back.encode(r), Codec(FRAME, params).encode(r))


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "foreign", "flipped"])
def test_damaged_weights_are_refused_in_one_line(tmp_path, damage):
    path = tmp_path / "w.safetensors"
    save_codec(path, Codec(TINY, {"params": {"kernel": np.ones((9, 9), np.float32)}}), {})
    content = path.read_bytes()
    flipped = content[:-7] + bytes([content[-7] ^ 1]) + content[-6:]
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(
            {"empty": b"", "cut": content[:-100], "foreign": b"x" * 1000, "flipped": flipped}[damage]
        )
    with pytest.raises(ValueError, match="holds no FL-VAE weights") as caught:
        load_codec(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("path", [RELEASED, BARYCENTRIC])
def test_released_weights_carry_a_digest_and_those_of_earlier_versions_need_none(tmp_path, path):
    with safe_open(path, "numpy") as file:
        entry = file.metadata()["flvae"]
    assert len(entry.partition(" ")[0]) == 64
    text, tensors = load_tensors(path, "flvae")
    (tmp_path / "old.safetensors").write_bytes(save(tensors, {"flvae": text}))
    assert load_codec(tmp_path / "old.safetensors").digest() == load_codec(path).digest()


def test_weights_are_named_or_a_path():
    vectors = load_codec("vectors")
    assert vectors.digest() == load_codec(VECTORS).digest() != load_codec().digest()
    assert vectors.config.invariants == 0 and vectors.config.latents == 8


@pytest.mark.slow
@pytest.mark.parametrize("name", [None, "vectors"])
def test_the_shipped_codecs_reconstruct_and_do_not_mind_the_frame(name):
    """At points near the vertices of rings that are smooth, and at any frames of these."""
    codec = load_codec(name)
    r = rings(300, codec.config.samples)
    queries = alone(r.logs[:, :3])
    colors = codec.decode(queries, codec.encode(r))
    asked = np.asarray(r.colors[:, :3]).reshape(-1, 3)
    assert np.sqrt(np.mean((colors - asked) ** 2)) < 0.05 < 0.15 < np.std(asked)

    turn = np.exp(1j * np.random.default_rng(0).uniform(-np.pi, np.pi, (300, 1))).astype(np.complex64)
    z = codec.encode(r._replace(logs=r.logs * turn))
    np.testing.assert_allclose(codec.decode(alone(r.logs[:, :3] * turn), z), colors, atol=1e-4)


@pytest.mark.slow
def test_the_effect_of_a_channel_is_that_of_its_unit_on_colours():
    """Brightness shows most; a quarter of the unit has a quarter of the effect."""
    codec = load_codec()
    latents = codec.encode(rings(200, codec.config.samples))
    plain = Scaling(np.zeros(8, np.complex64), np.full(8, 20 + 20j, np.complex64))
    whole, quarter = (
        codec.effects(latents, plain),
        codec.effects(latents, plain._replace(scale=4 * plain.scale)),
    )
    np.testing.assert_allclose(whole, 4 * quarter, rtol=0.15)
    assert whole.real.max() == whole.real[5] > 2 * np.median(whole.real)
