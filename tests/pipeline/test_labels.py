"""Laws of labels as samples follow them: by colour and not by number, on any mesh, or said why not."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.generators import ball_generator, colored_sphere, labelled_sphere
from helpers.surfaces import icosphere, moved
from helpers.textured import noise
from PIL import Image

from flx.assets.arrays import from_arrays
from flx.assets.read import read_asset
from flx.controls import Controls
from flx.geometry.tables import mesh_tables
from flx.pipeline.generator import Generator, Home, read_generator, save_generator
from flx.pipeline.labels import Labels, in_words, read_labels
from flx.pipeline.variations import controlled, generate, labels_for
from flx.types import Triangulation

pytestmark = pytest.mark.slow

BALL = icosphere(2)
HEIGHTS = np.digitize(BALL.vertices[:, 2], [-0.4, 0.5])  # as `labelled_sphere`; black, red, blue
KEY = jax.random.key(3)
ALONE = Controls(invention=1.0)


@pytest.fixture(scope="module")
def labelled(tmp_path_factory) -> Generator:
    return ball_generator(tmp_path_factory.mktemp("labelled"), labelled=True)


def known(generator: Generator) -> Labels:
    assert generator.labels
    return generator.labels


def turned(generator: Generator, order: list[int]) -> Generator:
    """The generator with its labels in another order, and the rows of the network that read them."""
    labels = known(generator)
    params = jax.tree.map(np.array, generator.params)
    kernel = params["params"]["embedding"]["RealDense_0"]["kernel"]
    kernel[-3:] = kernel[-3:][order]
    again = Labels(labels.palette[order], np.argsort(order)[labels.numbers].astype(np.int32))
    return dataclasses.replace(generator, params=params, labels=again)


def test_labels_in_another_order_give_the_same_codes(labelled):
    codes = labelled.sample(KEY, steps=4)
    other = turned(labelled, [2, 0, 1])
    np.testing.assert_allclose(other.sample(KEY, steps=4), codes, atol=1e-4)
    wrong = dataclasses.replace(other, labels=known(labelled))
    assert np.abs(wrong.sample(KEY, steps=4) - codes).max() > 0.1


def test_guidance_0_is_without_labels_and_1_with_them(labelled):
    numbers, home = known(labelled).numbers, labelled.home

    def codes(**how):
        return labelled.sample(KEY, home, steps=4, **how)

    bare, told = codes(), codes(labels=numbers)
    np.testing.assert_array_equal(codes(labels=numbers, guidance=0.0), bare)
    np.testing.assert_array_equal(labelled.sample(KEY, steps=4), told)  # its own, on its own copy
    np.testing.assert_allclose(codes(labels=numbers, guidance=1 + 1e-6), told, atol=1e-3)
    np.testing.assert_allclose(codes(labels=numbers, guidance=1e-6), bare, atol=1e-3)
    more = codes(labels=numbers, guidance=2.0)
    assert min(np.abs(a - b).max() for a, b in ((bare, told), (more, told), (more, bare))) > 0.1


def test_a_saved_generator_has_its_labels(labelled, tmp_path):
    save_generator(tmp_path / "a.safetensors", labelled)
    read = read_generator(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(read.sample(KEY, steps=4), labelled.sample(KEY, steps=4))
    assert known(read).palette.tolist() == [[0, 0, 0], [0, 0, 200], [200, 0, 0]]
    assert read.labelled is not None
    bent = dataclasses.replace(labelled, labels=Labels(known(labelled).palette[:2], known(labelled).numbers))
    save_generator(tmp_path / "b.safetensors", bent)
    with pytest.raises(ValueError, match="cannot be used as a generator"):
        read_generator(tmp_path / "b.safetensors")


def test_a_run_paints_by_its_own_labels_at_any_scale(labelled):
    """Zones of the same heights; vertices at the borders see half of each."""
    for scale in (1.0, 0.7):
        found = controlled(labelled, Controls(scale=scale, invention=1.0), labelled.asset)
        home, numbers = found.home, found.labels
        assert numbers is not None and len(numbers) == len(home.triangulation.vertices)
        height = home.triangulation.vertices[:, 2]
        clear = np.minimum(np.abs(height + 0.4), np.abs(height - 0.5)) > 0.2
        expected = np.array([0, 2, 1])[np.digitize(height, [-0.4, 0.5])]
        np.testing.assert_array_equal(numbers[clear], expected[clear])
        assert clear.sum() > 60 and len(set(numbers[clear])) == 3
    assert labels_for(labelled, Controls(guidance=0.0), labelled.asset, BALL) is None


def test_another_mesh_is_painted_by_labels_of_its_own(labelled, tmp_path, capsys):
    """A ball upside down, labelled as the first one is: what was up is down."""
    other = Triangulation(BALL.vertices * [1, -1, -1], BALL.faces)
    (tmp_path / "other.ply").write_bytes(colored_sphere(other))
    upright = np.array([0, 2, 1])[HEIGHTS]  # red is the last of the colours in order
    zones = colored_sphere(other, np.array([(0, 0, 0), (0, 0, 200), (200, 0, 0)])[upright])
    (tmp_path / "zones.ply").write_bytes(zones)
    asset, controls = read_asset(tmp_path / "other.ply"), Controls(labels=tmp_path / "zones.ply")
    found = labels_for(labelled, controls, asset, other)
    np.testing.assert_array_equal(found, known(labelled).numbers)
    assert labels_for(labelled, Controls(), asset, other) is None
    assert "no labels are given for it" in capsys.readouterr().err


def test_samples_follow_the_labels_that_are_given(labelled, tmp_path):
    """All of the ball in one label is what a generator paints whose own ball is in that label."""
    (tmp_path / "red.ply").write_bytes(colored_sphere(BALL, np.tile([[200, 0, 0]], (162, 1))))
    red = next(generate(labelled, 1, steps=3, controls=Controls(labels=tmp_path / "red.ply", invention=1.0)))
    all_red = Labels(known(labelled).palette, np.full(162, 2, np.int32))
    same = next(generate(dataclasses.replace(labelled, labels=all_red), 1, steps=3, controls=ALONE))
    np.testing.assert_array_equal(red.colors, same.colors)
    assert np.abs(red.colors - next(generate(labelled, 1, steps=3, controls=ALONE)).colors).max() > 0.01


def test_one_line_says_how_many_labels_there_are_and_how_large():
    labels = Labels(np.array([(0, 0, 0), (255, 128, 0)], np.uint8), np.zeros(162, np.int32))
    assert in_words(labels, mesh_tables(BALL)) == "2 labels, by area #000000 100.0%, #ff8000 0.0%"


# --- bad input


def sheet(path: Path):
    """A quad with a texture."""
    vertices = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0.0)])
    faces = np.array([(0, 1, 2), (0, 2, 3)])
    return from_arrays(vertices, faces, vertices[faces][..., :2], noise(32, 32), name=str(path))


def image(path: Path, *colors: tuple[int, int, int], side: int = 32) -> Path:
    stripes = np.array(colors, np.uint8).repeat(side, 0)[:, None].repeat(side, 1)
    Image.fromarray(stripes).save(path)
    return path


@pytest.mark.parametrize("side", [16, 32, 100])
def test_an_image_of_labels_may_have_any_size(tmp_path, side):
    found = read_labels(image(tmp_path / "l.png", (0, 0, 0), (255, 0, 0), side=side), sheet(tmp_path))
    assert found.palette.tolist() == [[0, 0, 0], [255, 0, 0]]


def shifted(path: Path) -> Path:
    path.write_bytes(labelled_sphere(moved(BALL, 1)))
    return path


def photograph(path: Path) -> Path:
    Image.fromarray(noise(64, 64)).save(path)
    return path


def text(path: Path) -> Path:
    path.write_text("labels")
    return path


GREYS = [(n, n, n) for n in range(0, 66, 2)]
BAD = [
    (lambda f: f / "none.png", r"none.png do not exist; paint"),
    (lambda f: photograph(f / "p.png"), r"p.png: only 0% of its texels have a flat colour; paint"),
    (lambda f: image(f / "g.png", *GREYS), r"g.png: it has 33 flat colours, more than 32; merge"),
    (lambda f: image(f / "o.png", (1, 2, 3)), r"o.png: it has 1 flat colour; paint"),
    (lambda f: text(f / "t.png"), r"t.png: .*no known kind; save"),
    (lambda f: text(f / "t.ply"), r"t.ply: .*;"),
    (lambda f: shifted(f / "s.ply"), r"s.ply: it lies elsewhere than the mesh that it labels; export"),
    (lambda f: f, r"labels .*;"),
]


@pytest.mark.parametrize(("made", "match"), BAD, ids=[match[:6] for _, match in BAD])
def test_a_file_that_holds_no_labels_is_refused_in_one_line(tmp_path, made, match):
    with pytest.raises(ValueError, match=match) as refusal:
        read_labels(made(tmp_path), sheet(tmp_path))
    assert "\n" not in str(refusal.value) and str(refusal.value).startswith("labels ")


def test_an_image_needs_texture_coordinates(labelled, tmp_path):
    with pytest.raises(ValueError, match=r"ball.ply has no texture coordinates; give labels as a PLY's"):
        read_labels(image(tmp_path / "l.png", (0, 0, 0), (9, 9, 9)), labelled.asset)


def test_what_was_not_learnt_is_refused(generator, labelled, tmp_path):
    (tmp_path / "zones.ply").write_bytes(labelled_sphere())
    given = Controls(labels=tmp_path / "zones.ply")
    for controls, what in ((given, "labels .*zones.ply"), (Controls(guidance=2.0), "guidance 2")):
        with pytest.raises(ValueError, match=rf"{what}: this run learnt no labels; train one with --surface"):
            next(generate(generator, 1, controls=controls))
    for how in ({"labels": np.zeros(162, np.int32)}, {"guidance": 2.0}):
        with pytest.raises(ValueError, match=r"none were learnt; train with --surface.labels"):
            generator.sample(KEY, steps=4, **how)
    (tmp_path / "green.ply").write_bytes(colored_sphere(BALL, np.tile([[0, 99, 0]], (162, 1))))
    with pytest.raises(ValueError, match=r"#006300 was never learnt; .* are #000000, #0000c8, #c80000"):
        next(generate(labelled, 1, controls=Controls(labels=tmp_path / "green.ply")))
    (tmp_path / "other.ply").write_bytes(colored_sphere(moved(BALL, 1)))
    with pytest.raises(ValueError, match=r"guidance 2: .*other.ply has no labels to follow; give an image"):
        next(generate(labelled, 1, controls=Controls(guidance=2.0, mesh=tmp_path / "other.ply")))
    for weight in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"guidance is .*give .*at least 0"):
            Controls(guidance=weight)


def test_a_copy_of_its_own_has_no_labels_unless_they_are_given(labelled):
    small = icosphere(1)
    home = Home(small, mesh_tables(small))
    numbers = np.arange(42, dtype=np.int32) % 3
    bare = labelled.sample(KEY, home, steps=4)
    assert np.abs(bare - labelled.sample(KEY, home, steps=4, labels=numbers)).max() > 0.1


@pytest.mark.parametrize(
    "numbers", [np.zeros(9, np.int32), np.full(162, 3, np.int32), np.full(162, -1, np.int32)]
)
def test_labels_that_are_no_numbers_of_them_are_refused(labelled, numbers):
    with pytest.raises(ValueError, match="labels do not fit; give 162 whole numbers from 0 to 2"):
        labelled.sample(jax.random.key(0), labels=numbers, steps=2)
