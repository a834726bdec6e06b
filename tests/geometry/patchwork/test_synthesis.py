"""Laws of patchworks: the same seed, the same bits; size and place do not matter; nothing is invented."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.surfaces import both, icosphere, moved, square_grid
from helpers.textured import noise, textured
from scipy.ndimage import gaussian_filter

from flx.geometry.patchwork.anchors import Anchors, Surface, placed
from flx.geometry.patchwork.appearance import ANGLES, EDGE, REACH, Source, gradients
from flx.geometry.patchwork.guides import curvature
from flx.geometry.patchwork.search import Usage, bank, distances, most_similar
from flx.geometry.patchwork.synthesis import (
    level_counts,
    own_places,
    pieces,
    prepare,
    synthesize,
)
from flx.geometry.remesh.remesh import remesh
from flx.types import TexturedMesh, Triangulation

COUNT = 320


def painted(shape: Triangulation, image: np.ndarray | None = None) -> TexturedMesh:
    corners = shape.vertices[shape.faces]
    low, high = shape.vertices.min(0), shape.vertices.max(0)
    uvs = (corners - low)[..., :2] / (high - low)[:2] * 0.9 + 0.05
    return textured(shape, uvs, gaussian_filter(noise(96, 96), (2, 2, 0)) if image is None else image)


BALL = painted(icosphere(3))


def synthesis_of(mesh: TexturedMesh, **more):
    return prepare(mesh, remesh(mesh.vertices, mesh.faces, COUNT, 7), 0, **more)


WHOLE = synthesis_of(BALL)


def test_levels_grow_by_at_most_four_from_a_third_of_the_surface():
    for finest in (100, 150, 151, 600, 5000, 30_000, 200_000):
        counts = level_counts(finest)
        assert counts[-1] == finest and counts == sorted(counts)
        assert all(b / a < 4.1 for a, b in pairwise(counts))
        assert len(counts) == 1 or counts[0] == 150


def test_the_same_seed_gives_the_same_bits_and_another_does_not():
    one, two, other = (synthesize(WHOLE, seed) for seed in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))
    assert (one.vertices != other.vertices).mean() > 0.5


def test_a_mesh_twice_as_large_gets_the_same_patchwork():
    """A factor of two is exact, so that remeshing takes the same decisions."""
    large = synthesis_of(BALL._replace(vertices=2 * BALL.vertices))
    one, two = synthesize(WHOLE, 1), synthesize(large, 1)
    assert (one.vertices == two.vertices).mean() > 0.99 and np.abs(one.turns - two.turns).mean() < 0.01


def test_a_moved_and_renumbered_mesh_gets_the_same_patchwork(monkeypatch):
    """On moved triangulations: which ones remeshing finds hangs on how numbers are rounded."""
    rng, layer = np.random.default_rng(5), BALL.maps["base_color"]
    order, faces = rng.permutation(len(BALL.vertices)), rng.permutation(len(BALL.faces))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)

    def motion(points):
        return points @ rotation + 3

    def moved_copy(vertices, triangles, count, seed):
        copy = remesh(BALL.vertices, BALL.faces, count, seed)
        return Triangulation(motion(copy.vertices), copy.faces)

    numbered = np.argsort(order)[BALL.faces].astype(BALL.faces.dtype)[faces]
    other = BALL._replace(vertices=motion(BALL.vertices[order]), faces=numbered)
    other = other.with_layer(corner_uvs=layer.corner_uvs[faces])
    monkeypatch.setattr("flx.geometry.patchwork.synthesis.remesh", moved_copy)
    there = prepare(other, moved_copy(None, None, COUNT, 7), 0)
    one, two = synthesize(WHOLE, 1), synthesize(there, 1)
    assert np.array_equal(one.vertices, two.vertices)
    assert np.abs(one.offsets - two.offsets).max() < 1e-3 and np.abs(one.turns - two.turns).max() < 1e-4
    source = there.levels[-1].source
    assert np.abs(source.look(two) - WHOLE.levels[-1].source.look(one)).max() < 1e-3


def test_moving_a_source_changes_nothing_of_what_it_looks_like():
    shape = Triangulation(BALL.vertices, BALL.faces)
    turned = moved(shape, 3, 1.0)
    copy = remesh(*shape, 600, 1)
    # The same copy on the moved mesh: the motion that took one to the other.
    a, b = (m.vertices - m.vertices.mean(0) for m in (shape, turned))
    rotation, _, _, _ = np.linalg.lstsq(a, b, rcond=None)
    there = Triangulation(
        (copy.vertices - shape.vertices.mean(0)) @ rotation + turned.vertices.mean(0), copy.faces
    )
    one = Source(BALL, Surface(copy), REACH * EDGE, 0)
    two = Source(BALL._replace(vertices=turned.vertices), Surface(there), REACH * EDGE, 0)
    assert np.abs(one.values - two.values).max() < 1e-3
    assert np.abs(one.charts - two.charts).mean() < 1e-4
    assert np.abs(curvature(one.surface) - curvature(two.surface)).max() < 1e-3


def test_a_chart_is_nearest_to_itself_and_a_turn_of_it_is_found():
    source = WHOLE.levels[-1].source
    rows = np.arange(0, len(source.surface), 97)
    own = Anchors(
        rows[:, None], np.zeros((len(rows), 1), np.complex64), np.ones((len(rows), 1), np.complex64)
    )
    assert distances(source, source.charts[rows], own).max() == 0
    some = bank(source, np.random.default_rng(0))
    at = np.arange(0, len(some.vertices), 50)
    turned = np.roll(source.charts[some.vertices[at]], -5, axis=1)
    places, turns = most_similar(some, turned)
    assert (places[:, 0] == at).mean() > 0.9 and (turns[:, 0] == 5).mean() > 0.9
    unit = np.exp(2j * np.pi * 5 / ANGLES).astype(np.complex64)
    found = Anchors(some.vertices[at][:, None], own.offsets[: len(at)] * 0, np.full((len(at), 1), unit))
    assert distances(source, turned, found).max() < 1e-9


def test_the_gradient_of_a_linear_function_is_its_slope():
    sheet = Surface(square_grid(9))
    values = (sheet.positions @ np.array([[2.0, 0], [-1.0, 1], [0, 0]])).astype(np.float32)
    slope = gradients(sheet, values) / sheet.radius
    inner = ~sheet.frames.boundary
    frame = sheet.x_axes[:, 0] + 1j * sheet.x_axes[:, 1]  # of each vertex, in the plane
    assert np.abs(slope * frame[:, None] - [2 - 1j, 1j])[inner].max() < 1e-3


def test_a_texture_of_one_colour_gives_that_colour():
    flat = synthesis_of(painted(icosphere(3), np.full((8, 8, 3), (200, 90, 30), np.uint8)))
    level = flat.levels[-1]
    seen = level.source.look(synthesize(flat, 0))
    assert np.abs(seen[:, :3] - np.array([200, 90, 30]) / 255).max() < 1e-3


def test_coherence_makes_pieces_larger():
    of = {
        c: [pieces(WHOLE, synthesize(WHOLE, seed, coherence=c)) for seed in range(3)] for c in (0.0, 0.2, 5.0)
    }
    small, usual, large = [np.mean([each.mean for each in of[c]]) for c in of]
    assert small < 0.05 < usual < large, "sizes"
    assert min(each.count for each in of[0.0]) > 10 * max(each.count for each in of[5.0])
    assert all(0 < each.largest <= 1 and each.copied < 0.3 for each in of[0.2])


def test_own_places_are_the_input_itself():
    level = WHOLE.levels[-1]
    own = own_places(level)
    found = pieces(WHOLE, own)
    assert found.count == 1 and found.copied == pytest.approx(1)
    assert np.linalg.norm(placed(level.source.surface, own)[0] - level.target.positions, axis=1).max() < 0.05


def test_what_is_not_free_comes_from_its_own_place():
    kept = remesh(BALL.vertices, BALL.faces, COUNT, 7).vertices[:, 2] > 0
    half = WHOLE._replace(free=~kept)
    anchors, own = synthesize(half, 0), own_places(half.levels[-1])
    assert (anchors.vertices[kept] == own.vertices[kept]).all()
    assert (anchors.vertices[~kept] != own.vertices[~kept]).mean() > 0.5
    nothing = synthesize(WHOLE._replace(free=np.zeros(COUNT, bool)), 0)
    assert all(np.array_equal(a, b) for a, b in zip(nothing, own, strict=True))


def test_nothing_is_taken_from_damaged_places():
    white = (BALL.vertices[BALL.faces].mean(1)[:, 1] > 0).astype(np.float32)
    colors = np.repeat(white, 9).reshape(-1, 3, 3)
    damaged = BALL.with_layer(images=())._replace(corner_colors=colors)
    synthesis = synthesis_of(BALL, damaged=damaged)
    anchors, level = synthesize(synthesis, 0), synthesis.levels[-1]
    assert placed(level.source.surface, anchors)[0][:, 1].max() < 0
    assert 0 < level.source.usable.mean() < 0.5


@pytest.mark.parametrize("shape", [square_grid(24), both(icosphere(3), icosphere(2), 3)])
def test_open_surfaces_and_several_parts_are_filled(shape):
    synthesis = synthesis_of(painted(shape))
    anchors, source = synthesize(synthesis, 0), synthesis.levels[-1].source
    assert source.can_give(anchors).mean() > 0.99 and np.isfinite(anchors.offsets).all()


def test_what_is_used_too_often_costs_more_by_place_and_by_look():
    surface, masses = WHOLE.levels[-1].target, WHOLE.levels[-1].target.frames.masses
    above, right = ((surface.positions[:, axis] > 0).astype(int) for axis in (2, 0))
    own = own_places(WHOLE.levels[-1])._replace(vertices=np.arange(len(surface)))
    fair = Usage(surface, above, right).prices(own, masses)
    assert np.abs(fair).max() < 1e-6, "all is used as much as there is of it"
    quarter = own._replace(vertices=np.resize(np.flatnonzero((above == 1) & (right == 1)), len(surface)))
    by_place, by_both = (Usage(surface, *ways).prices(quarter, masses) for ways in ([above], [above, right]))
    assert by_place[above == 1].min() > np.log(1.5) and by_place[above == 0].max() < -2
    assert (by_both[above + right == 2] > 1.5 * by_place[above == 1].max()).all()


def test_much_is_going_on_where_a_texture_is_not_flat():
    image = gaussian_filter(noise(96, 96), (2, 2, 0))
    image[:48] = 128
    source = Source(painted(icosphere(3), image), Surface(remesh(*icosphere(3), 900, 1)), REACH * EDGE, 0)
    flat = source.surface.positions[:, 1] < -0.5  # texture coordinates go up
    assert source.busy.mean() == pytest.approx(1, abs=1e-5)
    assert source.busy[flat].max() < 0.5 < 1.2 < source.busy[source.surface.positions[:, 1] > 0.5].min()
