"""Laws of directions: a field in space, whatever the frames, numbering, motion and triangulation."""

import numpy as np
import pytest
from helpers.surfaces import (
    both,
    bump,
    grid_faces,
    icosphere,
    moved,
    sheet,
    square_grid,
    torus,
    uneven_sphere,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.geometry.direction import (
    WORDS,
    Stroke,
    as_numbers,
    as_vectors,
    carried,
    check_direction,
    field_on,
)
from flx.geometry.tables import exact_tables
from flx.geometry.tangent import tangent_frames, transports
from flx.types import Triangulation

SEEDS = st.integers(0, 99)


def in_space(numbers: np.ndarray, mesh: Triangulation) -> np.ndarray:
    return as_vectors(numbers, mesh, tangent_frames(mesh))


def strokes_on(mesh: Triangulation, seed: int) -> tuple[Stroke, ...]:
    """A line from one face to a near one, and a point with a direction."""
    rng = np.random.default_rng(seed)
    a, b = mesh.vertices[mesh.faces[rng.choice(len(mesh.faces), 2)]].mean(1)
    near = mesh.vertices[np.argsort(np.linalg.norm(mesh.vertices - a, axis=1))[6]]
    return Stroke(np.stack([a, near])), Stroke(b[None], near - a)


def cylinder(around: int = 24, along: int = 12) -> Triangulation:
    """Open, its axis z: developable, since every face spans one step around."""
    row, column = np.divmod(np.arange(along * around), around)
    turn = 2 * np.pi * column / around
    points = np.stack([np.cos(turn), np.sin(turn), 0.25 * row], 1)
    faces = grid_faces(along, around, close_columns=True)
    a, b, c = points[faces[0]]
    outward = np.cross(b - a, c - a)[:2] @ a[:2] > 0
    return Triangulation(points, faces if outward else faces[:, ::-1])


@settings(max_examples=10)
@given(seed=SEEDS, turn=st.floats(-3, 3))
def test_one_stroke_on_a_plane_gives_its_direction_everywhere(seed, turn):
    plane, along = sheet(seed), np.array([np.cos(turn), np.sin(turn), 0])
    middle = plane.vertices.mean(0)
    drawn = Stroke(np.stack([middle, middle + 2 * along]))
    pointed = Stroke(middle[None], 3 * along)
    for stroke in (drawn, pointed):
        found = in_space(field_on((stroke,), plane), plane)
        np.testing.assert_allclose(found, np.tile(along, (len(found), 1)), atol=1e-9)


def test_a_stroke_along_a_cylinder_goes_along_all_of_it_and_one_around_around():
    mesh = cylinder()
    up = field_on((Stroke(mesh.vertices[[26, 26 + 48]]),), mesh)
    frames = tangent_frames(mesh)
    changes = up[:, None] - transports(frames) * up[frames.neighbors]
    assert np.abs(changes[frames.neighbors >= 0]).max() < 1e-9
    np.testing.assert_allclose(in_space(up, mesh), np.tile([0, 0, 1.0], (len(up), 1)), atol=2e-3)
    np.testing.assert_allclose(field_on("z", mesh), up, atol=2e-3)
    around = in_space(field_on((Stroke(mesh.vertices[[26, 27]]),), mesh), mesh)
    assert np.abs(around[:, 2]).max() < 2e-3
    radial = mesh.vertices * [1, 1, 0]
    np.testing.assert_allclose(np.cross(radial, around)[:, 2], 1, atol=0.02)
    bent = in_space(field_on("curvature", mesh), mesh)
    middle = np.abs(mesh.vertices[:, 2] - mesh.vertices[:, 2].mean()) < 1
    assert np.abs(bent[middle, 2]).max() < 0.02
    assert np.ptp(np.sign(np.cross(radial, bent)[middle, 2])) == 0  # one way round


def fields(mesh: Triangulation, strokes: tuple[Stroke, ...]) -> dict[str, np.ndarray]:
    return {"y": field_on("y", mesh), "strokes": field_on(strokes, mesh)}


@settings(max_examples=8)
@given(seed=SEEDS)
def test_moving_strokes_and_surface_together_changes_nothing(seed):
    """In frames; an axis stays behind, so its part is turned by hand."""
    for mesh in (uneven_sphere(seed), bump(seed)):
        strokes = strokes_on(mesh, seed)
        other = moved(mesh, seed)
        shift = other.vertices[0]
        rotation = np.linalg.lstsq(mesh.vertices - mesh.vertices[0], other.vertices - shift, rcond=None)[0]
        again = tuple(
            Stroke(
                (s.points - mesh.vertices[0]) @ rotation + shift,
                None if s.direction is None else s.direction @ rotation,
            )
            for s in strokes
        )
        here, there = field_on(strokes, mesh), field_on(again, other)
        np.testing.assert_allclose(there, here, atol=1e-5)
        assert np.abs(here).min() > 0.99 and np.abs(field_on(strokes, other) - here).max() > 0.1
        bent, turned = field_on("curvature", mesh), field_on("curvature", other)
        np.testing.assert_allclose(turned**2, bent**2, atol=1e-4)


@settings(max_examples=8)
@given(seed=SEEDS)
def test_numbering_frames_and_the_order_of_strokes_change_nothing(seed):
    """Vertices and faces in another order, faces begun at another corner: other frames throughout."""
    mesh, rng = uneven_sphere(seed), np.random.default_rng(seed)
    strokes = strokes_on(mesh, seed)
    order = rng.permutation(len(mesh.vertices))
    faces = np.roll(np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))], 1, axis=1)
    other = Triangulation(mesh.vertices[order], faces)
    for name, here in fields(mesh, strokes).items():
        there = fields(other, strokes[::-1])[name]
        np.testing.assert_allclose(in_space(there, other), in_space(here, mesh)[order], atol=1e-5)
        assert np.abs(there - here[order]).max() > 0.1
    bent, again = (in_space(field_on("curvature", m), m) for m in (mesh, other))
    np.testing.assert_allclose(np.abs((again * bent[order]).sum(1)), 1, atol=1e-4)


def test_numbers_are_those_of_the_tables():
    """On a plane the log of a neighbour, seen along the direction, is how much farther it is that way."""
    plane = sheet(2)
    frames, tables = tangent_frames(plane), exact_tables(plane)
    for axis, numbers in enumerate((field_on("x", plane), field_on("y", plane))):
        farther = np.real(numbers.conj()[:, None] * tables.fine.logs) * frames.radius
        steps = plane.vertices[tables.fine.neighbors, axis] - plane.vertices[:, None, axis]
        np.testing.assert_allclose(farther, steps, atol=1e-9)
        assert np.abs(steps).max() > 0.5


@pytest.mark.parametrize("word", WORDS)
def test_a_direction_is_carried_to_other_triangulations_of_its_surface(word):
    coarse, fine = torus(40, 20), torus(48, 26)
    field = field_on(word, coarse)
    assert set(np.round(np.abs(field), 9)) <= {0.0, 1.0}
    np.testing.assert_allclose(carried(field, coarse, coarse), field, atol=1e-6)
    here = in_space(carried(field, coarse, fine), fine)
    there = in_space(field_on(word, fine), fine)
    cosines = (here * there).sum(1)
    if word == "curvature":
        cosines *= np.sign(np.median(cosines))
    both_there = (np.linalg.norm(here, axis=1) > 0.5) & (np.linalg.norm(there, axis=1) > 0.5)
    assert both_there.mean() > 0.8 and np.quantile(cosines[both_there], 0.02) > 0.95


def test_vectors_of_numbers_are_numbers_of_vectors():
    mesh = uneven_sphere(3)
    frames, rng = tangent_frames(mesh), np.random.default_rng(0)
    numbers = np.exp(1j * rng.uniform(-np.pi, np.pi, len(mesh.vertices)))
    vectors = as_vectors(numbers, mesh, frames)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1)
    np.testing.assert_allclose(as_numbers(vectors, mesh, frames, 0.5), numbers)


def test_what_no_stroke_is_drawn_on_has_no_direction():
    two = both(icosphere(2), icosphere(2))
    found = field_on((Stroke(two.vertices[[0]], np.array([1.0, 2, 3])),), two)
    assert (np.abs(found[:162]) > 0.99).all() and not found[162:].any()


def test_an_axis_has_no_direction_where_the_surface_faces_along_it():
    ball = icosphere(3)
    found = np.abs(field_on("z", ball))
    height = np.abs(ball.vertices[:, 2])
    assert not found[height > 0.997].any() and np.allclose(found[height < 0.99], 1)


def test_curvature_runs_around_the_tube_of_a_torus_and_neighbours_agree():
    mesh = torus(48, 24)
    field = field_on("curvature", mesh)
    theta = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    around = np.stack([-np.sin(theta), np.cos(theta), 0 * theta], 1)
    assert np.abs((in_space(field, mesh) * around).sum(1)).max() < 0.2
    frames = tangent_frames(mesh)
    same = (field.conj()[:, None] * transports(frames) * field[frames.neighbors]).real
    assert same[frames.neighbors >= 0].min() > 0.9


BALL, PLANE = icosphere(3), square_grid(8)
BAD = [
    ("z", PLANE, "faces along that axis; choose another"),
    ("curvature", PLANE, "is flat; give an axis or strokes"),
    ((*strokes_on(BALL, 0), Stroke(BALL.vertices[[0]] * 1.3, np.ones(3))), BALL, r"strokes\[2\] is 0.3"),
    ((Stroke(np.array([[0, 0, -1.0], [0, 0, 1]])),), BALL, r"strokes\[0\] is .* away from the surface"),
    ((Stroke(np.array([[1e140, 0, 0]]), np.ones(3)),), BALL, r"strokes\[0\] is 1e\+140 away"),
    ((Stroke(np.array([[0.5, 0.5, 0]]), np.array([0, 0, 1.0])),), PLANE, r"\[0\] is at right angles"),
]


@pytest.mark.parametrize(("direction", "surface", "match"), BAD, ids=[match for *_, match in BAD])
def test_what_gives_no_direction_is_refused_in_one_line(direction, surface, match):
    with pytest.raises(ValueError, match=match) as refusal:
        check_direction(direction, surface)
    assert "\n" not in str(refusal.value) and ";" in str(refusal.value)


@pytest.mark.parametrize("direction", [*WORDS, strokes_on(BALL, 0)], ids=[*WORDS, "strokes"])
def test_what_gives_one_is_accepted(direction):
    check_direction(direction, BALL)
