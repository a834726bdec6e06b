"""Laws of the planar pieces that a prior learns."""

import dataclasses

import jax
import numpy as np
import pytest
from PIL import Image

from flx.config import FLDM, FLDMExperiment, Images, PriorExperiment, Sheets, Surface, Train
from flx.fields.diffusion import latent_scaling
from flx.pipeline.codec import load_codec
from flx.training.fldm import learn_fldm
from flx.training.prior import encode_pieces, learn_prior, make_sheets, rescaled, scaled_pieces

SHEETS, SCALES = Sheets(vertices=120, meshes=2, pieces=4), Images(smallest=2.0, largest=4.0)


@pytest.fixture(scope="module")
def images():
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (2, 64, 64, 3), np.uint8)
    return np.kron(coarse, np.ones((1, 8, 8, 1), np.uint8))


@pytest.fixture(scope="module")
def pieces(images):
    return encode_pieces(SHEETS, SCALES, make_sheets(SHEETS, 64), images, load_codec())


def test_places_in_the_plane_are_where_the_logs_say():
    """Points of a ring lie around its vertex as their logs do, up to the turn of the vertex's frame."""
    sheet = make_sheets(SHEETS, 16)[0]
    for v in range(0, 120, 17):
        places, logs = sheet.places[v], sheet.logs[v]
        turned = np.vdot(logs - logs.mean(), places - places.mean())
        turn = turned / abs(turned)
        np.testing.assert_allclose(places - places.mean(), turn * (logs - logs.mean()), atol=1e-3)


def test_pieces_go_by_turns_on_the_meshes_and_repeat(images, pieces):
    assert pieces.latents.shape == (4, 120, 8) and list(pieces.sheet) == [0, 1, 0, 1]
    again = encode_pieces(
        SHEETS, Images(smallest=2.0, largest=4.0), make_sheets(SHEETS, 64), images, load_codec()
    )
    np.testing.assert_array_equal(again.latents, pieces.latents)
    assert np.abs(pieces.latents[0] - pieces.latents[2]).max() > 0.1


def test_images_of_one_colour_are_refused():
    flat = np.full((1, 512, 512, 3), 90, np.uint8)
    with pytest.raises(ValueError, match=r"one flat colour; name another --images.folder"):
        encode_pieces(
            dataclasses.replace(SHEETS, pieces=1), Images(), make_sheets(SHEETS, 64), flat, load_codec()
        )


def test_each_piece_is_as_large_as_the_noise(pieces):
    codec = load_codec()
    plain = scaled_pieces(pieces.latents, codec, 0.0)
    np.testing.assert_allclose(np.abs(plain[:, :, :5]).mean(1), np.sqrt(np.pi / 2), rtol=1e-3)
    np.testing.assert_allclose(plain[:, :, 5:].real.std(1), 1, rtol=1e-3)
    emphasized = scaled_pieces(pieces.latents, codec, 0.5)
    assert not np.allclose(emphasized, plain)


def test_effects_are_rescaled_as_they_would_be_measured(pieces):
    codec, pool = load_codec(), pieces.latents.reshape(-1, 8)
    common, own = latent_scaling(pool, 3), latent_scaling(pieces.latents[1], 3)
    smaller = own._replace(scale=10 * own.scale)  # small enough for the decoder to be linear
    base = common._replace(scale=10 * common.scale)
    expected = codec.effects(pool, smaller)
    found = rescaled(codec.effects(pool, base), base, smaller)
    np.testing.assert_allclose(found.real, expected.real, rtol=0.15)


@pytest.mark.slow
def test_a_mesh_begins_where_the_prior_ended(tmp_path, images):
    for n, image in enumerate(images):
        Image.fromarray(image).save(tmp_path / f"{n}.png")
    model = FLDM(channels=4, embedding=8, blocks=(1, 1, 1), precision="float32")
    train = Train(steps=2, batch=2, checkpoint_every=1)
    folder = Images(folder=str(tmp_path), prints=0.5)
    prior = learn_prior(PriorExperiment(model=model, images=folder, sheets=SHEETS, train=train), tmp_path)
    start = str(prior.folder / "prior.safetensors")
    surface = Surface(vertices=200, copies=1)
    # A rate of nearly nothing: the parameters stay where they began.
    still = dataclasses.replace(train, learning_rate=1e-9, final_learning_rate=0.0)
    experiment = FLDMExperiment("mesh", model, surface, still, start=start)
    run = learn_fldm(experiment, tmp_path)
    from flx.training.load import load_generator
    from flx.training.start import load_prior

    begun = jax.tree.leaves(load_generator(run.folder).params)
    known = load_prior(start).params
    sizes = sorted(a.size for a in begun)
    assert sizes == sorted(a.size for a in known.values())
    np.testing.assert_allclose(
        sorted(float(np.abs(a).sum()) for a in begun),
        sorted(float(np.abs(a.astype(np.float32)).sum()) for a in known.values()),
        rtol=1e-3,
        atol=1e-4,
    )
    assert (
        learn_prior(PriorExperiment(model=model, images=folder, sheets=SHEETS, train=train), tmp_path).folder
        == prior.folder
    )  # the run is complete
