"""Laws of the patches of planar meshes that the FL-VAE is trained on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.files import png, png_bomb
from PIL import Image

from flx.config import FLVAE, Images
from flx.pipeline import patches as patching
from flx.pipeline.patches import PATCH_VERTICES, ImagePatches, Placement, load_images

CONFIG, MODEL = Images(queries=2), FLVAE(samples=16)


@pytest.fixture(scope="module")
def patches(tmp_path_factory) -> ImagePatches:
    """Over three smooth pictures, one of them small."""
    folder = tmp_path_factory.mktemp("images")
    y, x = np.mgrid[0:600, 0:700] / 600
    for k, size in enumerate([(600, 700), (520, 520), (100, 300)]):
        picture = 127 + 120 * np.sin(np.stack([x * (k + 3), y * 4, x + y], -1) * 3)
        Image.fromarray(picture[: size[0], : size[1]].astype(np.uint8)).save(folder / f"{k}.png")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(patching, "SHEETS", 3)
        patch.setattr(patching, "SHEET_VERTICES", 150)
        yield ImagePatches(Images(str(folder), queries=2), MODEL, 8)


def plain(count: int, **changed) -> Placement:
    """Patches of one pixel a mean radius at the middle of image 0, with its own colours."""
    ones = jnp.ones(count)
    placement = Placement(
        image=jnp.zeros(count, jnp.int32),
        scale=ones,
        turn=ones + 0j,
        stretch=ones,
        grain=ones + 0j,
        corner=jnp.full((count, 2), 0.5),
        channels=jnp.tile(jnp.arange(3), (count, 1)),
        contrast=ones,
        target=jnp.zeros((count, 3)),
        painted=0 * ones,
    )
    return placement._replace(**changed)


@pytest.mark.slow
def test_a_batch_is_the_same_in_every_run_and_another_at_another_step(patches):
    again = ImagePatches(patches.config, MODEL, 8)
    np.testing.assert_array_equal(patches(3).rings.colors, again(3).rings.colors)
    assert patches(3).colors.shape == (8 * PATCH_VERTICES * 2, 3)
    assert np.abs(patches(3).colors - patches(4).colors).max() > 0.1
    assert patches.digest == again.digest


@pytest.mark.slow
def test_every_point_lies_in_a_face_whose_corners_see_it_where_it_is(patches):
    """log and place differ by a turn and a shift: seen from two corners, points are as far apart."""
    bank = jax.tree.map(lambda a: np.asarray(a)[::20], patches.bank)
    corners = bank.queries.vertices[..., 0]
    assert bank.queries.vertices.min() >= 0 and bank.queries.vertices.max() < PATCH_VERTICES
    apart = np.abs(np.take_along_axis(bank.logs, corners[..., None], 1) - bank.queries.logs[..., :1])
    places = np.take_along_axis(bank.places, corners[..., None], 1)
    np.testing.assert_allclose(apart, np.abs(places - bank.query_places[..., None]), atol=2e-3)
    assert np.ptp(apart) > 1


@pytest.mark.slow
def test_a_ring_is_seen_turned_from_its_place_and_never_mirrored(patches):
    """Frames are right-handed: one turn leads from all logs of a ring to the steps between its places."""
    logs, places = (np.asarray(a)[::20] for a in (patches.bank.logs, patches.bank.places))
    turns = np.diff(places) / np.diff(logs)
    turn = turns.mean(-1, keepdims=True)
    np.testing.assert_allclose(np.abs(turn), 1, atol=2e-3)
    steps = np.abs(np.diff(places) - turn * np.diff(logs))
    assert steps.max() < 0.01 and np.abs(np.diff(logs)).mean() > 0.5
    assert np.abs(np.diff(places) - turn * np.diff(logs).conj()).max() > 1


@pytest.mark.slow
def test_queries_are_uniform_over_the_faces_of_a_patch(patches):
    """Barycentrics of uniform points have the mean 1/3 and the variance 1/18."""
    weights = np.asarray(patches.bank.queries.barycentrics).reshape(-1, 3)
    np.testing.assert_allclose(weights.mean(0), 1 / 3, atol=0.01)
    np.testing.assert_allclose(weights.var(0), 1 / 18, atol=0.003)


@pytest.mark.slow
def test_patches_side_by_side_do_not_share_vertices(patches):
    batch = patches(0)
    owner = np.asarray(batch.queries.vertices) // PATCH_VERTICES
    np.testing.assert_array_equal(owner, np.repeat(np.arange(8), PATCH_VERTICES * 2)[:, None].repeat(3, 1))


@pytest.mark.slow
def test_rings_and_queries_read_the_same_picture(patches):
    """Where a query lies near a ring's sample, the smooth pictures give both nearly the same colour."""
    step = patches(1)
    logs, colors = np.asarray(step.rings.logs), np.asarray(step.rings.colors)
    corners, seen = np.asarray(step.queries.vertices)[:, 0], np.asarray(step.queries.logs)[:, 0]
    distances = np.abs(logs[corners] - seen[:, None])
    nearest = distances.argmin(1)
    close = np.flatnonzero(distances.min(1) < 0.1)
    found = colors[corners[close], nearest[close]]
    assert len(close) > 10 and np.abs(found - np.asarray(step.colors)[close]).max() < 0.1 < np.ptp(colors)


def test_colours_are_those_under_the_point():
    """On a picture that is linear in x, bilinear reading gives x itself."""
    ramp = np.zeros((1, 32, 256, 3), np.uint8)
    ramp[..., 0] = np.arange(256)
    x = jnp.linspace(0.3, 250.7, 11)[None]
    colors = patching.bilinear(jnp.asarray(ramp), jnp.array([0]), x, jnp.full_like(x, 7.25))
    np.testing.assert_allclose(colors[0, :, 0] * 255, x[0], atol=1e-3)


@pytest.mark.slow
def test_a_lay_scales_turns_and_stretches_about_the_middle():
    """On the same ramp, colours tell x: 127.5 at the middle."""
    ramp = np.zeros((1, 256, 256, 3), np.uint8)
    ramp[..., 0] = np.arange(256)
    places = jnp.array([[0, 3, 3j, -2 - 1j]])

    def read(**changed):
        return (
            np.asarray(patching.colors_at(jnp.asarray(ramp), plain(1, **changed), places)[0])[0, :, 0] * 255
        )

    one = jnp.ones(1)
    np.testing.assert_allclose(read(), 127.5 + np.array([0, 3, 0, -2]), atol=1e-3)
    np.testing.assert_allclose(read(scale=4 * one), 127.5 + 4 * np.array([0, 3, 0, -2]), atol=1e-3)
    np.testing.assert_allclose(read(turn=1j * one), 127.5 + np.array([0, 0, -3, 1]), atol=1e-3)
    np.testing.assert_allclose(read(stretch=1.5 * one), 127.5 + np.array([0, 4.5, 0, -3]), atol=1e-3)
    turned = read(stretch=1.5 * one, grain=1j * one)
    np.testing.assert_allclose(turned, 127.5 + np.array([0, 2, 0, -4 / 3]), atol=1e-3)


@pytest.mark.slow
def test_a_lay_reaches_from_one_border_of_its_image_to_the_other():
    ramp = np.zeros((1, 256, 256, 3), np.uint8)
    ramp[..., 0], ramp[..., 1] = np.arange(256), np.arange(256)[:, None]
    lay = plain(3, corner=jnp.array([[0, 0], [1, 0], [0.25, 1]]))
    read = patching.colors_at(jnp.asarray(ramp), lay, jnp.tile(jnp.array([0, 5, -3j]), (3, 1)))[0]
    np.testing.assert_allclose(255 * read[:, 0, :2], [[5, 5], [250, 5], [66.25, 250]], atol=2e-3)


@pytest.mark.slow
def test_what_is_painted_anew_is_measured_from_the_mean_of_the_rings():
    """Channels change places; without contrast all has the rings' level, wherever the queries lie."""
    ramp = np.zeros((1, 256, 256, 3), np.uint8)
    ramp[..., 0] = np.arange(256)
    rings, queries = jnp.array([[-50.0, 50.0 + 0j]]), jnp.array([[20.0 + 0j, 40.0, 30.0]])
    one = jnp.ones(1)
    order = jnp.array([[1, 2, 0]])
    mixed = patching.colors_at(jnp.asarray(ramp), plain(1, channels=order, painted=one), rings, queries)
    np.testing.assert_allclose(255 * mixed[1][0, :, 2], 127.5 + np.array([20, 40, 30]), atol=1e-2)
    np.testing.assert_allclose(mixed[1][..., :2], 0, atol=1e-6)
    flat = patching.colors_at(jnp.asarray(ramp), plain(1, contrast=0 * one, painted=one), rings, queries)
    np.testing.assert_allclose(255 * flat[1], 127.5 / 3, atol=1e-2)


@pytest.mark.slow
def test_half_of_the_patches_are_painted_anew_and_within_range():
    picture = np.random.default_rng(4).integers(0, 256, (1, 64, 64, 3)).astype(np.uint8)
    lay = patching.random_placement(jax.random.key(0), 4000, 1, CONFIG)._replace(scale=jnp.ones(4000))
    places = jnp.asarray(np.random.default_rng(5).normal(size=(4000, 6)) * (1 + 1j), jnp.complex64)
    painted = patching.colors_at(jnp.asarray(picture), lay, places)[0]
    kept = patching.colors_at(jnp.asarray(picture), lay._replace(painted=jnp.zeros(4000)), places)[0]
    share = np.mean(np.all(painted == kept, axis=(1, 2)))
    assert 0.45 < share < 0.55 and painted.min() == 0 and painted.max() == 1


def test_a_folder_without_images_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no images"):
        ImagePatches(Images(folder=str(tmp_path)), FLVAE(), 4)


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n(x) run\nshowpage\n%%EOF\n"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (POSTSCRIPT, "photo.png' is of no known kind"),
        (png_bomb(20_000, 20_000), "photo.png' has more than"),
        (png()[:-40], "photo.png' is broken"),
        (b"", "photo.png' is of no known kind"),
    ],
)
def test_an_image_of_the_folder_is_decoded_as_safely_as_a_texture(tmp_path, monkeypatch, content, told):
    """A PostScript file, whatever it is called, would start Ghostscript."""
    (tmp_path / "gs").write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    (tmp_path / "gs").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    (tmp_path / "photo.png").write_bytes(content)
    with pytest.raises(ValueError, match=told) as refusal:
        load_images(tmp_path)
    assert "\n" not in str(refusal.value) and not (tmp_path / "started").exists()


def test_images_with_alpha_or_of_one_channel_are_read_as_their_colours(tmp_path):
    for name, mode, color in (("a", "RGBA", (10, 20, 30, 77)), ("b", "L", 9), ("c", "I;16", 257 * 40)):
        Image.new(mode, (512, 512), color).save(tmp_path / f"{name}.png")
    assert load_images(tmp_path)[:, 0, 0].tolist() == [[10, 20, 30], [9, 9, 9], [40, 40, 40]]
