"""Laws of labels: colours name them, borders are resolved, and they stay where they are on the surface."""

import numpy as np
import pytest
from helpers.surfaces import icosphere, moved, square_grid
from helpers.textured import quad, textured
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from flx.geometry.labels import MOST, LabelMap, corner_labels, image_labels, labels_on, shares
from flx.geometry.sampling import positions
from flx.types import SurfacePoints, TexturedMesh, Triangulation

WHOLE = quad([(0, 0), (1, 0), (1, 1), (0, 1)])
COLORS = st.lists(
    st.tuples(*[st.sampled_from([0, 60, 120, 180, 240])] * 3), min_size=4, max_size=4, unique=True
)
BALL = icosphere(2)


def quarters(colors: list, side: int) -> np.ndarray:
    """A picture of four squares."""
    return np.array(colors, np.uint8).reshape(2, 2, 3).repeat(side // 2, 0).repeat(side // 2, 1)


@settings(max_examples=30)
@given(colors=COLORS, seed=st.integers(0, 99))
def test_a_smoothed_border_gets_the_flat_colour_that_covers_most_of_a_texel(colors, seed):
    """Drawn four times as large and reduced, as painting programs do, off the grid of texels."""
    left, top = np.random.default_rng(seed).integers(-3, 4, 2)
    large = np.roll(np.pad(quarters(colors, 128), ((64, 64), (64, 64), (0, 0)), "edge"), (top, left), (0, 1))
    large = large[60:-60, 60:-60]  # nothing that was rolled over the rim is in it
    smooth = np.asarray(Image.fromarray(large).resize((34, 34), Image.Resampling.BOX))
    found = image_labels(WHOLE, smooth)
    assert sorted(map(tuple, found.palette.tolist())) == sorted(colors)
    blocks = large.reshape(34, 4, 34, 4, 1, 3) == found.palette
    covered = blocks.all(5).sum((1, 3))  # by each label, of the 16 pixels that a texel stands for
    away = np.abs(np.arange(34) - 16.5) > 4
    clear = (away[:, None] | away) & (covered.max(2) > 8)  # not where all four meet
    np.testing.assert_array_equal(found.numbers[clear], covered.argmax(2)[clear])
    assert clear.mean() > 0.85 and (covered.max(2) < 16).any() == bool(left % 4 or top % 4)


def test_a_mixture_that_is_like_a_third_label_becomes_one_of_its_two():
    """Grey between black and white, which is exactly the colour of a third label elsewhere."""
    image = np.zeros((32, 32, 3), np.uint8)
    image[:, 17:] = 255
    image[:, 16] = 128
    image[24:, :] = 128
    found = image_labels(WHOLE, image)
    assert found.palette.tolist() == [[0] * 3, [128] * 3, [255] * 3]
    assert set(found.numbers[:20, 16]) <= {0, 2} and (found.numbers[24:] == 1).all()


@given(colors=COLORS, seed=st.integers(0, 99))
def test_labels_are_numbered_by_colour_however_they_are_painted(colors, seed):
    one, other = (image_labels(WHOLE, quarters(order, 16)) for order in (colors, colors[::-1]))
    np.testing.assert_array_equal(one.palette, other.palette)
    np.testing.assert_array_equal(one.numbers, other.numbers[::-1, ::-1])
    assert (np.bincount(one.numbers.ravel()) == 64).all()


def test_what_no_face_shows_is_no_label():
    """The background between charts, and a blot on it."""
    part = quad([(0.1, 0.1), (0.6, 0.1), (0.6, 0.9), (0.1, 0.9)])
    image = np.zeros((64, 64, 3), np.uint8)
    image[4:60, 4:20], image[4:60, 20:42], image[:, 50:] = (250, 0, 0), (0, 250, 0), (9, 9, 9)
    assert image_labels(part, image).palette.tolist() == [[0, 250, 0], [250, 0, 0]]
    assert len(image_labels(WHOLE, image).palette) == 4


def zones(mesh: Triangulation) -> TexturedMesh:
    """Three zones by height, as colours of corners."""
    middles = mesh.vertices[mesh.faces].mean(1)[:, 2]
    colors = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1.0)], np.float32)
    corners = colors[np.digitize(middles, [-0.4, 0.5])][:, None].repeat(3, 1)
    return textured(mesh, np.zeros((len(mesh.faces), 3, 2)))._replace(corner_colors=corners)


@settings(max_examples=10)
@given(seed=st.integers(0, 99))
def test_labels_stay_where_they_are_however_a_copy_is_numbered_and_moved(seed):
    rng, surface, copy = np.random.default_rng(seed), zones(icosphere(3)), BALL
    numbers = labels_on(corner_labels(surface), copy)
    assert np.bincount(numbers, minlength=3).min() > 10
    order = rng.permutation(len(copy.vertices))
    turned = np.argsort(order)[copy.faces][rng.permutation(len(copy.faces))]
    again = Triangulation(copy.vertices[order], np.roll(turned, seed % 3, 1))
    np.testing.assert_array_equal(labels_on(corner_labels(surface), again), numbers[order])
    there = surface._replace(vertices=moved(icosphere(3), seed).vertices)
    np.testing.assert_array_equal(labels_on(corner_labels(there), moved(copy, seed)), numbers)


def test_a_vertex_has_the_label_that_fills_most_of_its_ring():
    """Left of the border by a tenth of an edge, and right of it."""
    image = np.zeros((200, 200, 3), np.uint8)
    grid = square_grid(11)
    grid = Triangulation(
        (grid.vertices - grid.vertices.min(0)) / np.ptp(grid.vertices, axis=0).max(), grid.faces
    )
    for border in (90, 110):
        image[:, :border], image[:, border:] = (0, 0, 0), (255, 255, 255)
        numbers = labels_on(image_labels(WHOLE, image), grid)
        middle = np.abs(grid.vertices[:, 0] - 0.5) < 1e-9
        assert middle.sum() == 11 and (numbers[middle] == (border == 90)).all()


def test_a_thin_wall_has_a_label_on_each_side():
    inner = Triangulation(0.99 * BALL.vertices, BALL.faces[:, ::-1])
    both = Triangulation(
        np.concatenate([BALL.vertices, inner.vertices]), np.concatenate([BALL.faces, inner.faces + 162])
    )
    colors = np.zeros((640, 3, 3), np.float32)
    colors[320:] = 1
    surface = textured(both, np.zeros((640, 3, 2)))._replace(corner_colors=colors)
    numbers = labels_on(corner_labels(surface), Triangulation(0.995 * BALL.vertices, BALL.faces))
    assert (numbers == 0).all()
    turned = Triangulation(0.995 * BALL.vertices, BALL.faces[:, ::-1])
    assert (labels_on(corner_labels(surface), turned) == 1).all()


def test_shares_are_of_the_area():
    numbers, masses = np.array([0, 2, 2], np.int32), np.array([1.0, 2.0, 5.0])
    np.testing.assert_allclose(shares(numbers, masses, 4), [1 / 8, 0, 7 / 8, 0])


def stripes(count: int) -> np.ndarray:
    grey = np.arange(count, dtype=np.uint8).repeat(4)[:, None, None]
    return np.broadcast_to(grey, (4 * count, 64, 3)).copy()


def test_a_picture_that_is_none_of_labels_is_refused():
    photograph = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    photograph[:8] = 255  # blown out
    for image, match in (
        (photograph, r"only 1\d% of its texels have a flat colour; paint"),
        (stripes(MOST + 1), r"33 flat colours, more than 32; merge"),
        (stripes(1), r"1 flat colour; paint at least two"),
    ):
        with pytest.raises(ValueError, match=match):
            image_labels(WHOLE, image)
    assert len(image_labels(WHOLE, stripes(MOST)).palette) == MOST


def test_a_label_that_was_never_learnt_is_named_with_the_nearest_ones():
    learnt = np.array([(0, 0, 0), (200, 0, 0), (0, 0, 200)], np.uint8)
    image = quarters([(0, 0, 0), (203, 2, 0), (0, 0, 200), (0, 0, 0)], 16)  # one is nearly a learnt colour
    found = image_labels(WHOLE, image, learnt)
    assert isinstance(found, LabelMap) and sorted(set(found.numbers.ravel())) == [0, 1, 2]
    image = quarters([(0, 0, 0), (100, 20, 0), (0, 0, 200), (0, 0, 0)], 16)
    with pytest.raises(ValueError, match=r"#641400 was never learnt; .* are #000000, #c80000, #0000c8"):
        image_labels(WHOLE, image, learnt)


def test_a_corner_says_what_is_near_it():
    found = corner_labels(zones(BALL))
    points = SurfacePoints(np.arange(320), np.tile([0.2, 0.7, 0.1], (320, 1)))
    heights = positions(*BALL, points)[:, 2]
    assert (found.palette[found.at(points)][heights > 0.7] == [0, 0, 255]).all()
