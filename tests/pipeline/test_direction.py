"""Laws of a direction as samples follow it: on any mesh, turned, from words or strokes, or said why not."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from helpers.generators import ball_generator, colored_sphere
from helpers.surfaces import icosphere, moved

from flx.assets.read import read_asset
from flx.controls import Controls
from flx.geometry.direction import Stroke, field_on
from flx.geometry.tables import mesh_tables
from flx.pipeline.direction import read_direction
from flx.pipeline.generator import Generator, Home, read_generator, save_generator
from flx.pipeline.variations import controlled, direction_for, generate
from flx.types import Triangulation

pytestmark = pytest.mark.slow

BALL = icosphere(2)
KEY = jax.random.key(3)
POLE, EQUATOR = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]
FACE = BALL.vertices[BALL.faces[0]]
MIDDLE, NORMAL = FACE.mean(0).tolist(), np.cross(FACE[1] - FACE[0], FACE[2] - FACE[0]).tolist()
NAN = float("nan")


@pytest.fixture(scope="module")
def directed(tmp_path_factory) -> Generator:
    return ball_generator(tmp_path_factory.mktemp("directed"), direction="z")


def learnt(generator: Generator) -> np.ndarray:
    assert generator.direction is not None
    return generator.direction


def written(path: Path, *strokes: dict) -> Path:
    path.write_text(json.dumps({"strokes": strokes}))
    return path


def test_guidance_0_is_without_a_direction_and_1_with_it(directed):
    def codes(**how):
        return directed.sample(KEY, directed.home, steps=4, **how)

    way = learnt(directed)
    bare, told = codes(), codes(direction=way)
    np.testing.assert_array_equal(codes(direction=way, guidance=0.0), bare)
    np.testing.assert_array_equal(codes(direction=0 * way), bare)
    np.testing.assert_array_equal(directed.sample(KEY, steps=4), told)  # its own, on its own copy
    np.testing.assert_allclose(codes(direction=way, guidance=1 + 1e-6), told, atol=1e-3)
    more, turned = codes(direction=way, guidance=2.0), codes(direction=1j * way)
    for a, b in ((bare, told), (more, told), (more, bare), (turned, told)):
        assert np.abs(a - b).max() > 0.02


def test_a_turn_by_0_degrees_is_none_and_turns_add_up(directed):
    def way(degrees: float) -> np.ndarray:
        found = direction_for(directed, Controls(rotate=degrees), directed.asset, directed.home.triangulation)
        assert found is not None
        return found

    np.testing.assert_array_equal(way(0.0), learnt(directed))
    np.testing.assert_allclose(way(90.0), 1j * learnt(directed), atol=1e-12)
    np.testing.assert_allclose(way(-270.0), way(90.0), atol=1e-12)
    np.testing.assert_allclose(way(180.0), -learnt(directed), atol=1e-12)


def test_a_saved_generator_has_its_direction(directed, tmp_path):
    save_generator(tmp_path / "a.safetensors", directed)
    read = read_generator(tmp_path / "a.safetensors")
    np.testing.assert_array_equal(learnt(read), learnt(directed))
    np.testing.assert_array_equal(read.sample(KEY, steps=4), directed.sample(KEY, steps=4))
    assert read.experiment.surface.direction == "z"


def test_a_run_paints_by_its_own_direction_at_any_scale(directed):
    found = controlled(directed, Controls(scale=0.8, invention=1.0), directed.asset)
    home, way = found.home, found.direction
    assert way is not None and len(way) == len(home.triangulation.vertices) > 162
    wanted = field_on("z", home.triangulation)
    there = (way != 0) & (wanted != 0)
    assert there.mean() > 0.9 and np.real(way.conj() * wanted)[there].min() > 0.95
    assert direction_for(directed, Controls(guidance=0.0), directed.asset, BALL) is None


def test_samples_follow_the_direction_that_is_given(directed, tmp_path):
    """A line, and the same one with the direction along it; or the axis that was learnt, by its name."""
    line = {"points": [EQUATOR, [np.cos(0.2), np.sin(0.2), 0.0]]}
    file = written(tmp_path / "a.json", line)
    same = written(tmp_path / "b.json", line | {"direction": [np.cos(0.2) - 1, np.sin(0.2), 0]})
    found = [direction_for(directed, Controls(direction=str(p)), directed.asset, BALL) for p in (file, same)]
    np.testing.assert_allclose(*found, atol=1e-9)
    drawn, own = (
        next(generate(directed, 1, steps=3, controls=Controls(direction=way, invention=1.0)))
        for way in (str(file), None)
    )
    z = next(generate(directed, 1, steps=3, controls=Controls(direction="z", invention=1.0)))
    np.testing.assert_array_equal(z.colors, own.colors)
    assert np.abs(drawn.colors - own.colors).max() > 0.01


def test_another_mesh_is_painted_by_a_direction_of_its_own(directed, tmp_path, capsys):
    (tmp_path / "other.ply").write_bytes(colored_sphere(moved(BALL, 1)))
    asset = read_asset(tmp_path / "other.ply")
    there = Triangulation(asset.mesh.vertices, asset.mesh.faces)
    assert direction_for(directed, Controls(), asset, there) is None
    assert "no direction is given for it" in capsys.readouterr().err
    way = direction_for(directed, Controls(direction="x", rotate=90.0), asset, there)
    np.testing.assert_allclose(way, 1j * field_on("x", there), atol=1e-12)


# --- bad input


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


BAD = [
    (lambda f: f / "none.json", r"none.json does not exist; give x, y, z, curvature"),
    (lambda f: text(f / "t.json", "strokes"), "it is not JSON; write"),
    (lambda f: text(f / "d.json", "[" * 100_000), "it is not JSON; write"),
    (lambda f: text(f / "l.json", "[]"), "it has no strokes; write"),
    (lambda f: written(f / "e.json"), "it has no strokes; write"),
    (lambda f: text(f / "n.json", '{"strokes": [3]}'), r"strokes\[0\] has no list of points; write"),
    (lambda f: written(f / "p.json", {"points": []}), r"strokes\[0\] has too few points, 0; give"),
    (lambda f: written(f / "1.json", {"points": [POLE]}), r"strokes\[0\] has too few points, 1; give"),
    (lambda f: written(f / "s.json", {"points": [POLE, POLE]}), r"strokes\[0\] has no length; give"),
    (lambda f: written(f / "o.json", {"points": [POLE], "way": POLE}), r"unknown field 'way'; give"),
    (lambda f: written(f / "z.json", {"points": [POLE], "direction": [0, 0, 0]}), "direction is zero; give"),
    (
        lambda f: written(f / "a.json", {"points": [POLE, [0, NAN, 1]]}),
        r"points\[1\] is \[0, NaN, 1\]",
    ),
    (lambda f: written(f / "i.json", {"points": [[float("inf"), 0, 0], POLE]}), r"points\[0\] is \[Infinity"),
    (lambda f: written(f / "h.json", {"points": [[1e200, 0, 0], POLE]}), r"points\[0\] is \[1e\+200"),
    (lambda f: written(f / "b.json", {"points": [[True, 0, 0], POLE]}), r"points\[0\] is \[true"),
    (lambda f: written(f / "2.json", {"points": [[0, 1], POLE]}), r"points\[0\] is \[0, 1\]; give three"),
    (lambda f: written(f / "f.json", {"points": [POLE, [0, 9, 9]]}), "away from the surface.*; draw it on"),
    (lambda f: written(f / "m.json", {"points": [POLE] * 10_001}), "it has 10,001 points; give at most"),
    (
        lambda f: written(f / "r.json", {"points": [MIDDLE], "direction": NORMAL}),
        "at right angles to .*; draw",
    ),
    (lambda f: f, r"direction .*;"),
]


@pytest.mark.parametrize(("made", "match"), BAD, ids=[match[:30] for _, match in BAD])
def test_a_file_that_holds_no_strokes_is_refused_in_one_line(generator, tmp_path, made, match):
    with pytest.raises(ValueError, match=match) as refusal:
        read_direction(str(made(tmp_path)), generator.asset)
    assert "\n" not in str(refusal.value) and str(refusal.value).startswith("direction ")


def test_strokes_are_read_as_they_are(generator, tmp_path):
    north = [0.0, 0.1, 0.99]
    second = {"points": [EQUATOR], "direction": [0, 2, 0]}
    file = written(tmp_path / "s.json", {"points": [POLE, north]}, second)
    drawn, pointed = read_direction(str(file), generator.asset)
    assert isinstance(drawn, Stroke) and isinstance(pointed, Stroke)
    assert drawn.points.tolist() == [POLE, north] and drawn.direction is None
    assert pointed.direction is not None and pointed.direction.tolist() == [0, 1, 0]


def test_what_was_not_learnt_is_refused(generator, directed, tmp_path):
    for controls, what in ((Controls(direction="z"), "direction z"), (Controls(rotate=90.0), "rotate 90")):
        with pytest.raises(
            ValueError, match=rf"{what}: this run learnt no direction; train one with --surface"
        ):
            next(generate(generator, 1, controls=controls))
    with pytest.raises(ValueError, match=r"none was learnt; train with --surface.direction"):
        generator.sample(KEY, steps=4, direction=np.ones(162, complex))
    (tmp_path / "other.ply").write_bytes(colored_sphere(moved(BALL, 1)))
    other = tmp_path / "other.ply"
    with pytest.raises(ValueError, match=r"rotate 90: .*other.ply has no direction to turn; give one"):
        next(generate(directed, 1, controls=Controls(rotate=90.0, mesh=other)))
    with pytest.raises(ValueError, match=r"guidance 2: .*other.ply has no direction to follow; give one"):
        next(generate(directed, 1, controls=Controls(guidance=2.0, mesh=other)))
    for turn in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"rotate is .*give a number"):
            Controls(rotate=turn)


@pytest.mark.parametrize("way", [np.ones(9, complex), np.full(162, 2.0 + 0j), np.full(162, np.nan + 0j)])
def test_numbers_that_are_no_directions_are_refused(directed, way):
    with pytest.raises(ValueError, match="direction does not fit; give 162 unit complex numbers"):
        directed.sample(KEY, direction=way, steps=2)


def test_a_copy_of_its_own_has_no_direction_unless_it_is_given(directed):
    small = icosphere(1)
    home = Home(small, mesh_tables(small))
    bare = directed.sample(KEY, home, steps=4)
    assert np.abs(bare - directed.sample(KEY, home, steps=4, direction=field_on("z", small))).max() > 0.02
