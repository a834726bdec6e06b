"""Which options of `flx sample` go together: all pairs, and what one line says of those that do not."""

import dataclasses
import json
import sys
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from helpers.generators import function_generator
from helpers.surfaces import square_grid
from helpers.textured import noise
from PIL import Image

from flx.assets.arrays import from_arrays
from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.commands.sample import Sample, instant_plan, learnt_plan, sample
from flx.controls import Controls, Patches
from flx.pipeline.generator import Generator
from flx.pipeline.instant import patch_generator
from flx.pipeline.variations import generate

OPTIONS = {
    "keep": Path("mask.png"),
    "fill": Path("mask.png"),
    "labels": Path("zones.png"),  # on the UVs of either mesh
    "mesh": Path("other.glb"),
    "scale": 0.8,
    "direction": "x",
    "rotate": 90.0,
    "height": "z",
    "guidance": 2.0,
    "strength": 0.5,
    "invention": 0.5,
    "variants": True,
    "instant": True,
}
BOTH = "keep is mask.png and fill mask.png; give one, each says what both would"
MASKED = "mask mask.png is one of the learnt texture; leave it out for another mesh"
UNLEARNABLE = ("strength", "invention", "instant")
UNLEARNT = "but nothing is learnt here; train a run, or leave it out"
# What a run that learnt labels and a direction does not do together.
REFUSED = {
    ("keep", "fill"): BOTH,
    ("keep", "mesh"): MASKED,
    ("fill", "mesh"): MASKED,
    ("mesh", "strength"): "strength is 0.5; leave it out for another mesh, other.glb",
    ("mesh", "rotate"): "rotate 90: other.glb has no direction to turn; give one with --direction",
    (
        "mesh",
        "guidance",
    ): "guidance 2: other.glb has no labels to follow; give an image on its UVs with --labels",
    ("strength", "invention"): "strength is 0.5 and invention 0.5; give one: strength begins with the input, "
    "invention with pieces",
    ("height", "strength"): "height is z, but strength is 0.5: there are no pieces; leave one of them out",
    ("strength", "instant"): f"strength is 0.5, {UNLEARNT}",
    ("invention", "instant"): f"invention is 0.5, {UNLEARNT}",
}
NOTHING = (
    "guidance is 2.0, but there is nothing to follow; give labels, a direction or a height, or leave it out"
)
TURNED = "rotate is 90.0, but there is no direction; give it with --direction"
# What a mesh file does not do without training; a set says what makes it possible.
ALONE = {"guidance": (NOTHING, {"labels", "direction", "height"}), "rotate": (TURNED, {"direction"})}
OF_A_MESH = {
    ("keep", "fill"): BOTH,
    ("keep", "mesh"): MASKED,
    ("fill", "mesh"): MASKED,
    ("labels", "mesh"): "labels zones.png are those of other.glb; give the input's with --input-labels",
}


@pytest.fixture
def run(tmp_path, monkeypatch) -> Generator:
    """A generator, and what the options name, in the current folder."""
    monkeypatch.chdir(tmp_path)
    generator = function_generator(tmp_path)
    grid = square_grid(9)
    sheet = from_arrays(3.5 * grid.vertices, grid.faces, grid.vertices[grid.faces][..., :2], noise(64, 96))
    write(sheet, own_painting(sheet), tmp_path / "other.glb")
    zones = np.array([(0, 0, 0), (200, 0, 0), (0, 0, 200)], np.uint8)[np.arange(96) * 3 // 96]
    Image.fromarray(np.broadcast_to(zones, (64, 96, 3))).save("zones.png")
    Image.fromarray(np.uint8(255) * (np.arange(64)[:, None] + np.zeros((64, 96)) < 32)).save("mask.png")
    monkeypatch.setattr("flx.training.load.load_generator", lambda _: generator)
    return generator


class Begun(Exception):
    """The first work after all checks."""


def begin(*_) -> None:
    raise Begun


def refusal_of(made: Callable[..., object], names: tuple[str, ...], source: str) -> str | None:
    """The line that refuses these options; None where work begins."""
    try:
        made(given(names, source))
    except ValueError as refusal:
        return str(refusal)
    except Begun:
        pass
    return None


def given(names: tuple[str, ...], source: str) -> Sample:
    own = {name: OPTIONS[name] for name in names if name in ("variants", "instant")}
    return Sample(
        run=Path(source), controls=Controls(**{n: OPTIONS[n] for n in names if n not in own}), **own
    )


def test_options_of_a_run_go_together_or_one_line_says_why_not(run, monkeypatch):
    """By the command and from Python alike, and before anything is written: nothing is made here."""
    monkeypatch.setattr("flx.pipeline.variations.home_on", begin)
    before = sorted(Path().iterdir())

    def in_python(options: Sample) -> None:
        generate(run, controls=options.controls)

    for pair in combinations(OPTIONS, 2):
        expected = REFUSED.get(pair)
        plan = instant_plan if "instant" in pair else learnt_plan
        assert refusal_of(plan, pair, "run") == expected, pair
        if "instant" not in pair:
            assert refusal_of(in_python, pair, "run") == expected, pair
    assert sorted(Path().iterdir()) == before


def test_options_without_training_go_together_or_one_line_says_why_not(run, monkeypatch):
    """The same where there is a mesh file alone."""
    monkeypatch.setattr("flx.pipeline.instant.remesh", begin)
    before = sorted(Path().iterdir())

    def by_command(options: Sample) -> None:
        instant_plan(options).paint()

    def in_python(options: Sample) -> None:
        patch_generator(run.asset, controls=options.controls)

    for pair in combinations([name for name in OPTIONS if name not in UNLEARNABLE], 2):
        alone = [said for name, (said, needs) in ALONE.items() if name in pair and not needs & {*pair}]
        expected = OF_A_MESH.get(pair) or next(iter(alone), None)
        assert refusal_of(by_command, (*pair, "instant"), "ball.glb") == expected, pair
        assert refusal_of(in_python, pair, "ball.glb") == expected, pair
    assert sorted(Path().iterdir()) == before


def image(name: str, *shape: int, color: tuple[int, int, int] = (0, 0, 0)) -> Path:
    Image.fromarray(np.broadcast_to(np.array(color, np.uint8), (*shape, 3))).save(name)
    return Path(name)


def text(name: str, content: str) -> Path:
    Path(name).write_text(content)
    return Path(name)


def strokes(points: str) -> str:
    return str(text("strokes.json", f'{{"strokes": [{{"points": {points}}}]}}'))


def green_corner() -> Path:
    pixels = np.zeros((64, 96, 3), np.uint8)
    pixels[:, 48:] = 0, 200, 0
    Image.fromarray(pixels).save("green.png")
    return Path("green.png")


TETRAHEDRON = "v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BAD = {
    "a mask of another size": (
        lambda: {"keep": image("m.png", 7, 9)},
        "mask m.png has 9 × 7 pixels but the texture 96 × 64; make them equal",
    ),
    "a mask that is none": (
        lambda: {"fill": text("m.png", "black")},
        "image 'm.png' is of no known kind; save it as PNG or JPEG",
    ),
    "a label that was never learnt": (
        lambda: {"labels": green_corner()},
        "labels green.png: colour #00c800 was never learnt; the nearest labels that were are",
    ),
    "a mesh without UVs and without the extra": (
        lambda: {
            "mesh": text(
                "bare.obj", "v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
            )
        },
        "bare.obj has no texture coordinates; pip install '.[uv]' in the clone makes them",
    ),
    "an empty file": (lambda: {"mesh": text("none.obj", "")}, "none.obj is empty; export it again"),
    "a mesh without faces": (lambda: {"mesh": text("dots.obj", "v 0 0 0\nv 1 0 0\n")}, "dots.obj"),
    "strokes that are no numbers": (
        lambda: {"direction": strokes("[[1, 0, 0], [NaN, 0, 1]]")},
        "direction strokes.json: strokes[0].points[1] is [NaN, 0, 1]; give three finite numbers",
    ),
    "strokes elsewhere": (
        lambda: {"direction": strokes("[[9, 0, 0], [9, 0, 1]]")},
        "direction strokes.json: ",
    ),
    "a scale that leaves nothing": (lambda: {"scale": 9.0}, "ball.glb at scale 9 has 2 vertices"),
}


@pytest.mark.parametrize("instant", [False, True])
@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(run, monkeypatch, what, instant):
    monkeypatch.setitem(sys.modules, "xatlas", None)
    made, line = BAD[what]
    controls = Controls(**made())
    before = sorted(Path().rglob("*"))
    with pytest.raises(ValueError) as refusal:
        sample(
            Sample(
                run=Path("run"),
                instant=instant,
                controls=controls,
                patches=Patches(vertices=162 if instant else 5000),
            )
        )
    assert str(refusal.value).replace(str(run.asset.path), "ball.glb").startswith(line)
    assert "\n" not in str(refusal.value) and sorted(Path().rglob("*")) == before


def test_what_is_refused_late_leaves_nothing_behind(run, monkeypatch):
    """Where the other mesh has no triangulation that would do, say."""
    monkeypatch.setattr("flx.pipeline.variations.home_on", begin)
    with pytest.raises(Begun):
        sample(given(("labels",), "run"))
    assert not Path("samples").exists()


@pytest.mark.parametrize(
    ("names", "more", "why"),
    [
        ((), {}, None),
        (
            (),
            {"invention": 1.0},
            "they follow pieces, which --strength and --invention 1 do without",
        ),
        (("strength",), {}, "they follow pieces, which --strength and --invention 1 do without"),
        (("variants",), {}, "variants share them"),
        (("mesh",), {}, None),  # whose material has none
        (("variants", "instant"), {}, "variants share them"),
        (("instant",), {}, None),
    ],
)
def test_one_line_says_where_other_maps_stay_as_they_are(run, monkeypatch, capsys, names, more, why):
    asset = run.asset._replace(map_names={"normal": ("n.png",), "metallic_roughness": ("r.png",)})
    run.__dict__["asset"] = run.__dict__["asset_with_maps"] = asset
    for work in ("flx.pipeline.variations.home_on", "flx.pipeline.instant.remesh"):
        monkeypatch.setattr(work, begin)
    options = given(names, "run")
    controls = dataclasses.replace(options.controls, **more)
    with pytest.raises(Begun):
        sample(dataclasses.replace(options, controls=controls))
    lines = [line for line in capsys.readouterr().err.splitlines() if "stay as they are" in line]
    assert len(lines) == (why is not None)
    if why:
        assert lines[0].startswith(f"ball.glb: normal, metallic roughness maps stay as they are: {why}")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "more"),
    [
        (("keep", "labels", "scale", "rotate", "guidance", "variants"), {"invention": 1.0}),
        (("mesh", "labels", "direction", "rotate", "guidance", "scale"), {}),
        (("fill", "labels", "direction", "scale", "instant", "variants"), {}),
        (("mesh", "labels", "direction", "rotate", "instant"), {}),
    ],
)
def test_many_at_once_make_textures(run, names, more):
    options = given(names, "run")
    controls, out = dataclasses.replace(options.controls, **more), Path("out")
    quick = {"patches": Patches(vertices=162)} if options.instant else {"steps": 3}
    quick |= {"count": 1, "texture_size": 96, "viewer": False}
    made = sample(dataclasses.replace(options, controls=controls, out=out, **quick))
    record = json.loads((made / "samples.json").read_text())
    name = "variants.glb" if options.variants else "variation_00.glb"
    assert record["files"] == [name]
    assert options.instant or record["vertices"] == pytest.approx(162 / 0.8**2, abs=3)
    before = controls.mesh or Path("ball.glb")
    new, old = (read_asset(path).mesh.textures[0].astype(int) for path in (made / name, before))
    assert new.shape == old.shape and np.abs(new - old).mean() > 5
    if controls.keep or controls.fill:
        stays = (np.arange(64) < 32) == bool(controls.keep)
        np.testing.assert_array_equal(new[stays], old[stays])
        assert np.abs(new - old)[~stays].mean() > 5
