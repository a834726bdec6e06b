"""Laws of textures without training: original texels, all maps in register, kept texels to the bit."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers.surfaces import icosphere, square_grid
from helpers.textured import noise
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import gaussian_filter

import flx
from flx.assets.arrays import from_arrays
from flx.assets.asset import Asset, Texture, own_painting
from flx.assets.formats.glb import glb_bytes
from flx.assets.formats.gltf import Gltf, append, append_view, read_gltf
from flx.assets.formats.images import encode_png
from flx.assets.read import read_with_maps
from flx.commands.sample import Sample, sample
from flx.controls import Controls, Patches
from flx.geometry.atlas import atlas_texels
from flx.geometry.patchwork.anchors import Anchors
from flx.geometry.patchwork.synthesis import own_places
from flx.pipeline.instant import (
    PatchGenerator,
    color_shifts,
    open_canvases,
    painted,
    patch_generator,
    patchworks,
    tangent_axes,
)
from flx.types import Layer

SMALL = Patches(vertices=300)


def sheet(color: np.ndarray | None = None, normal: np.ndarray | None = None) -> Asset:
    """The unit square with its own picture, right up to the edge, and a normal map if there is one."""
    grid = square_grid(9)
    uvs = grid.vertices[grid.faces][..., :2] * [1, -1] + [0, 1]  # v runs down
    picture = gaussian_filter(noise(64, 64), (2, 2, 0)) if color is None else color
    asset = from_arrays(*grid, uvs, picture)
    if normal is None:
        return asset
    layer = Layer((normal,), np.zeros(len(grid.faces), np.int64), asset.mesh.corner_uvs)
    sources = {**asset.sources, "normal": (Texture("bumps", None, False),)}
    mesh = asset.mesh._replace(maps={**asset.mesh.maps, "normal": layer})
    return asset._replace(mesh=mesh, sources=sources)


def ball() -> Asset:
    """A sphere seen from above and from below, two charts on one texture."""
    mesh = icosphere(3)
    corners = mesh.vertices[mesh.faces]
    below = corners.mean(1)[:, 2] < 0
    uvs = corners[..., :2] * [0.22, 0.44] + [0.25, 0.5] + below[:, None, None] * [0.5, 0.0]
    return from_arrays(*mesh, uvs, gaussian_filter(noise(128, 256), (3, 3, 0)))


BALL = ball()
WHOLE = patch_generator(BALL, SMALL)


def result(generator: PatchGenerator, anchors: Anchors, size: int | None = None):
    return painted(generator, open_canvases(generator, size), anchors)


def test_own_places_give_the_input_back():
    """To the blur of one more bilinear look-up: nothing is lost to a codec."""
    new = result(WHOLE, own_places(WHOLE.synthesis.levels[-1]))
    other = result(WHOLE, WHOLE.sample(0))
    assert flx.fidelity(BALL, new)["psnr"] > max(40, flx.fidelity(BALL, other)["psnr"] + 10)


def test_new_textures_have_the_colours_of_the_input_and_differ():
    one, other = patchworks(WHOLE, count=2)
    again = next(patchworks(WHOLE, count=1))
    assert np.array_equal(one.images[0], again.images[0]), "the same seed, the same bits"
    assert np.abs(one.images[0].astype(int) - other.images[0]).mean() > 5
    for image in (one.images[0], other.images[0]):
        for percent in (5, 50, 95):
            levels = [np.percentile(i, percent, (0, 1)) for i in (image, BALL.mesh.textures[0])]
            assert np.abs(levels[0] - levels[1]).max() < 25


def test_processes_find_the_same_pieces_in_the_same_order():
    seeds = [[0, n] for n in range(3)]
    for one, two in zip(WHOLE.every(seeds), WHOLE.every(seeds, 2), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))


def test_shifts_of_colour_close_steps_of_brightness_and_leave_one_piece_alone():
    assert np.abs(color_shifts(WHOLE.synthesis, own_places(WHOLE.synthesis.levels[-1]))).max() < 0.01
    rows = np.arange(64)[:, None, None]
    dark = np.full((64, 64, 3), 100, np.uint8)
    bright = np.uint8(dark + 15 * (rows >= 32))
    generator = patch_generator(sheet(bright), Patches(vertices=300, coherence=0.0))
    level = generator.synthesis.levels[-1]
    own = own_places(level)
    swapped = own.at(np.arange(300))
    upper = level.target.positions[:, 1] > 0.5
    top, bottom = np.flatnonzero(upper), np.flatnonzero(~upper)
    swapped.put(top[::2], own.at(bottom[: len(top[::2])]))
    shifts = color_shifts(generator.synthesis, swapped)
    assert 0.2 * 15 / 255 < np.abs(shifts).max() < 1.2 * 15 / 255


@cache
def leaning_sheet() -> PatchGenerator:
    return patch_generator(sheet(normal=np.full((16, 16, 3), 128, np.uint8)), SMALL)


@settings(max_examples=5)
@given(turn=st.floats(0, 6.28), lean=st.floats(0, 6.28))
def test_normals_lean_as_the_piece_is_turned(turn, lean):
    """On a flat sheet whose normal map leans everywhere alike."""
    x, y = 0.6 * np.cos(lean), 0.6 * np.sin(lean)
    normal = np.rint(np.broadcast_to(np.array([x, y, 0.8]) / 2 + 0.5, (16, 16, 3)) * 255).astype(np.uint8)
    flat = leaning_sheet()
    generator = replace(flat, mesh=flat.mesh.with_layer("normal", images=(normal,)))
    own = own_places(generator.synthesis.levels[-1])
    unit = np.complex64(np.exp(1j * turn))
    middle = np.full(300, np.linalg.norm(generator.triangulation.vertices - [0.5, 0.5, 0], axis=1).argmin())
    of = own.at(middle)
    # Every vertex comes from the middle, its x axis turned; so do the axes of its own frame.
    target = generator.synthesis.levels[-1].target
    frame = target.x_axes[:, 0] + 1j * target.x_axes[:, 1]
    anchors = Anchors(of.vertices, of.offsets, (of.turns * unit * frame / frame[middle]).astype(np.complex64))
    new = result(generator, anchors).maps["normal"][0] / 255 * 2 - 1
    expected = complex(x, y) * np.conj(unit)
    assert np.abs(new[4:-4, 4:-4, 0] - expected.real).max() < 0.05
    assert np.abs(new[4:-4, 4:-4, 1] - expected.imag).max() < 0.05
    assert np.abs(new[4:-4, 4:-4, 2] - 0.8).max() < 0.05


def test_tangent_axes_are_right_and_up_on_the_texture_even_where_it_is_mirrored():
    asset = sheet(normal=np.full((4, 4, 3), 128, np.uint8))
    right, up = tangent_axes(asset.mesh)
    assert np.allclose(right, [1, 0, 0], atol=1e-6) and np.allclose(up, [0, 1, 0], atol=1e-6)
    uvs = asset.mesh.maps["normal"].corner_uvs * [-1, 1]
    right, up = tangent_axes(asset.mesh.with_layer("normal", corner_uvs=uvs))
    assert np.allclose(right, [-1, 0, 0], atol=1e-6) and np.allclose(up, [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("option", ["keep", "fill"])
def test_kept_texels_are_the_same_bits_and_the_rest_is_new(tmp_path, option):
    image = BALL.mesh.textures[0]
    left = np.zeros(image.shape[:2], bool)
    left[:, :128] = True  # the upper half of the ball
    Image.fromarray(np.uint8(255) * (left if option == "keep" else ~left)).save(tmp_path / "mask.png")
    generator = patch_generator(BALL, SMALL, controls=Controls(**{option: tmp_path / "mask.png"}))
    new = next(patchworks(generator, count=1)).images[0]
    assert np.array_equal(new[left], image[left])
    assert np.abs(new[~left].astype(int) - image[~left]).mean() > 5
    if option == "fill":  # pieces come from what is kept alone
        places = generator.synthesis.levels[-1].source.surface.positions[generator.sample([0, 0]).vertices]
        assert places[:, 2].min() > -0.15, "the lowest corner of a face that is kept"


def test_damage_smaller_than_a_ring_is_repaired(tmp_path):
    image = BALL.mesh.textures[0]
    dots = np.zeros(image.shape[:2], bool)
    for row, column in ((40, 50), (64, 64), (80, 90), (64, 190)):
        dots[row : row + 3, column : column + 3] = True
    Image.fromarray(np.uint8(255) * dots).save(tmp_path / "dots.png")
    generator = patch_generator(BALL, SMALL, controls=Controls(fill=tmp_path / "dots.png"))
    new = next(patchworks(generator, count=1)).images[0]
    assert (new[dots] != image[dots]).any(1).mean() > 0.9 and np.array_equal(new[~dots], image[~dots])


def test_other_maps_are_kept_with_the_colours(tmp_path):
    asset = sheet(normal=noise(64, 64, 5))
    white = np.zeros((64, 64), np.uint8)
    white[:32] = 255
    Image.fromarray(white).save(tmp_path / "mask.png")
    made = next(patchworks(patch_generator(asset, SMALL, controls=Controls(keep=tmp_path / "mask.png"))))
    for slot in ("base_color", "normal"):
        before = asset.mesh.maps[slot].images[0]
        assert np.array_equal(made.maps[slot][0][:32], before[:32])
        assert (made.maps[slot][0][34:] != before[34:]).mean() > 0.5


def test_all_kept_is_the_input_and_nothing_kept_is_no_mask(tmp_path):
    for value, name in ((255, "all.png"), (0, "none.png")):
        Image.new("L", (256, 128), value).save(tmp_path / name)
    kept = patch_generator(BALL, SMALL, controls=Controls(keep=tmp_path / "all.png"))
    assert np.array_equal(next(patchworks(kept)).images[0], BALL.mesh.textures[0])
    free = patch_generator(BALL, SMALL, controls=Controls(keep=tmp_path / "none.png"))
    assert np.array_equal(next(patchworks(free)).images[0], next(patchworks(WHOLE)).images[0])


def test_another_mesh_in_other_units_keeps_the_size_of_details():
    grid = square_grid(9)
    uvs = grid.vertices[grid.faces][..., :2]
    other = from_arrays(1000 * grid.vertices, grid.faces, uvs, np.zeros((48, 48, 3), np.uint8))
    for scale, count in ((1.0, 300), (0.5, 1200)):
        generator = patch_generator(BALL, SMALL, target=other, controls=Controls(scale=scale))
        level = generator.synthesis.levels[-1]
        assert len(level.target) == count and len(level.source.surface) == pytest.approx(1200, abs=2)
        assert level.step == pytest.approx(2, rel=0.02), "a detail has as many edges as in the source"
        new = next(patchworks(generator))
        assert np.abs(new.images[0].mean((0, 1)) - BALL.mesh.textures[0].mean((0, 1))).max() < 30


def test_the_height_that_is_asked_for_reaches_the_pieces():
    for axis, rising in (("z", 1), (None, 0)):
        generator = patch_generator(BALL, SMALL, controls=Controls(height=axis))
        assert all(c.heights.max() == rising for c in generator.synthesis.levels[-1].characters)


def test_colours_at_vertices_are_patched_as_well():
    mesh = icosphere(3)
    colors = gaussian_filter(np.random.default_rng(0).random((len(mesh.vertices), 3)), (0, 0))
    asset = from_arrays(*mesh, colors=colors)
    new = next(patchworks(patch_generator(asset, SMALL)))
    assert not new.images and new.colors.shape == (len(mesh.vertices), 3)
    assert new.colors.std() > 0.05 and abs(new.colors.mean() - 0.5) < 0.1


@pytest.mark.parametrize(
    ("patches", "controls", "message"),
    [
        ({}, {"strength": 0.5}, "strength is 0.5, but nothing is learnt here; train a run, or leave it out"),
        (
            {},
            {"guidance": 2.0},
            "guidance is 2.0, but there is nothing to follow; give labels, a direction or a height, or leave "
            "it out",
        ),
        ({}, {"rotate": 90.0}, "rotate is 90.0, but there is no direction; give it with --direction"),
        (
            {"input_direction": "x"},
            {},
            "input direction is x, but there is no direction; give it with --direction",
        ),
        (
            {},
            {"labels": "map.png", "mesh": "square.obj"},
            "labels map.png are those of square.obj; give the input's with --input-labels",
        ),
        (
            {"input_labels": "map.png"},
            {"mesh": "square.obj"},
            "input labels map.png: square.obj has none yet; give them with --labels",
        ),
        (
            {},
            {"direction": "strokes.json", "mesh": "square.obj"},
            "direction strokes.json is drawn on square.obj; say which way the input runs with "
            "--input-direction",
        ),
    ],
)
def test_what_cannot_be_followed_is_refused(tmp_path, monkeypatch, patches, controls, message):
    monkeypatch.chdir(tmp_path)
    Path("square.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    patches, controls = (
        {
            name: Path(said) if name in ("labels", "mesh", "input_labels") else said
            for name, said in of.items()
        }
        for of in (patches, controls)
    )
    if "square.obj" in message:  # which gets coordinates first
        pytest.importorskip("xatlas", reason="xatlas is not installed: pip install '.[uv]'")
    with pytest.raises(ValueError) as refusal:
        patch_generator(BALL, Patches(vertices=300, **patches), controls=Controls(**controls))
    assert str(refusal.value) == message


def test_labels_and_a_direction_are_followed_without_training(tmp_path):
    """Above and below change places; then all is turned by half a turn."""
    halves = np.zeros((128, 256, 3), np.uint8)
    halves[:, 128:] = (255, 0, 0)  # the lower half of the ball
    for name, image in (("own.png", halves), ("swapped.png", halves[:, ::-1])):
        Image.fromarray(np.ascontiguousarray(image)).save(tmp_path / name)
    patches = Patches(vertices=300, input_labels=tmp_path / "own.png")
    controls = Controls(labels=tmp_path / "swapped.png", direction="x", rotate=180.0)
    generator = patch_generator(BALL, patches, controls=controls)
    level, anchors = generator.synthesis.levels[-1], generator.sample(0)
    places = level.source.surface.positions[anchors.vertices]
    away = np.abs(level.target.positions[:, 2]) > 0.2
    assert (places[:, 2] * level.target.positions[:, 2] < 0)[away].mean() > 0.95
    own, there = level.characters
    along = np.conj(own.directions[anchors.vertices]) * anchors.turns * there.directions
    assert (along.real > 0)[np.abs(along) > 0.5].mean() > 0.95
    target = level.target
    axes = there.directions.real[:, None] * target.x_axes + there.directions.imag[:, None] * target.y_axes
    assert axes[:, 0].max() <= 1e-6, "along x, turned by half a turn"


def test_labels_of_the_input_alone_keep_each_part_in_its_place(tmp_path):
    halves = np.zeros((128, 256, 3), np.uint8)
    halves[:, 128:] = (255, 0, 0)
    Image.fromarray(halves).save(tmp_path / "own.png")
    patches = Patches(vertices=300, input_labels=tmp_path / "own.png")
    generator = patch_generator(BALL, patches)
    level, anchors = generator.synthesis.levels[-1], generator.sample(0)
    z = level.target.positions[:, 2]
    same = level.source.surface.positions[anchors.vertices][:, 2] * z > 0
    assert same[np.abs(z) > 0.2].mean() > 0.95


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"vertices": 99}, "vertices is 99; give at least 100"),
        ({"vertices": 200_001}, "vertices is 200001; give at most 200,000"),
        ({"coherence": -1.0}, "coherence is -1.0; give at least 0"),
        ({"guide": float("nan")}, "guide is nan; give a number of at least 0"),
    ],
)
def test_numbers_outside_their_range_are_refused(wrong, message):
    with pytest.raises(ValueError) as refusal:
        Patches(**wrong)
    assert str(refusal.value) == message


def test_an_image_may_replace_the_texture(tmp_path):
    flx.save(BALL, own_painting(BALL), tmp_path / "ball.glb")
    Image.new("RGB", (64, 32), (200, 30, 60)).save(tmp_path / "red.png")
    options = {"texture": tmp_path / "red.png", "patches": SMALL, "viewer": False, "out": tmp_path / "out"}
    out = sample(Sample(run=tmp_path / "ball.glb", instant=True, count=1, **options))
    assert (flx.load(out / "variation_00.glb").mesh.textures[0] == (200, 30, 60)).all()


def test_a_mesh_of_too_many_parts_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parts = square_grid(2)
    corners = np.concatenate([parts.vertices + np.array([3.0 * n, 0, 0]) for n in range(60)])
    faces = np.concatenate([parts.faces + 4 * n for n in range(60)])
    colors = np.random.default_rng(0).random(corners.shape)
    many = from_arrays(corners, faces, colors=colors)
    flx.save(many, own_painting(many), "many.ply")
    with pytest.raises(ValueError, match=r"^many.ply: remeshing .* ask for more vertices \(--vertices\)$"):
        options = {"instant": True, "format": "ply", "patches": Patches(vertices=100)}
        sample(Sample(run=Path("many.ply"), **options))
    assert not list(tmp_path.glob("runs/**/*.json"))


def test_the_command_writes_all_and_says_how_large_the_pieces_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flx.save(BALL, next(patchworks(WHOLE)), "ball.glb")
    options = {"instant": True, "patches": SMALL, "texture_size": 64}
    out = sample(Sample(run=tmp_path / "ball.glb", count=2, **options))
    assert out.name == "ball-instant-texture-size-64-vertices-300"
    record = json.loads((out / "samples.json").read_bytes())
    assert record["files"] == ["variation_00.glb", "variation_01.glb"] and record["method"] == "instant"
    assert [set(of) for of in record["pieces"]] == [{"count", "largest", "mean", "copied"}] * 2
    assert {"variation_00.png", "contact_sheet.png", "viewer.html"} <= {file.name for file in out.iterdir()}
    assert flx.load(out / "variation_01.glb").mesh.textures[0].shape == (32, 64, 3)


def test_all_maps_of_a_material_follow_in_register(tmp_path):
    """Metal and roughness that are the colours backwards remain so; variants share them, and leave them."""
    flx.save(BALL, own_painting(BALL), tmp_path / "plain.glb")
    plain = read_gltf(tmp_path / "plain.glb")
    document, views = json.loads(json.dumps(plain.document)), list(plain.views)
    image = BALL.mesh.textures[0]
    for slot, pixels in (("normal", noise(128, 256, 5)), ("metallic_roughness", image[..., ::-1])):
        view = append_view(document, views, encode_png(np.ascontiguousarray(pixels), None))
        number = append(document, "images", {"bufferView": view, "mimeType": "image/png"})
        reference = {"index": append(document, "textures", {"source": number})}
        material = document["materials"][0]
        if slot == "normal":
            material["normalTexture"] = reference
        else:
            material["pbrMetallicRoughness"]["metallicRoughnessTexture"] = reference
    path = tmp_path / "ball.glb"
    path.write_bytes(glb_bytes(Gltf(document, tuple(views))))
    before = read_with_maps(path)
    assert set(before.mesh.maps) == {"base_color", "normal", "metallic_roughness"}
    options = {"run": path, "instant": True, "patches": SMALL, "viewer": False}
    one = read_with_maps(sample(Sample(**options, count=1, out=tmp_path / "one")) / "variation_00.glb").mesh
    color, metal, normal = (one.maps[s].images[0] for s in ("base_color", "metallic_roughness", "normal"))
    shown = atlas_texels(one, 0, *color.shape[:2]).covered
    assert np.abs(metal[..., ::-1].astype(int) - color)[shown].mean() < 3, "but for the shifts of colour"
    assert np.abs(normal.astype(int) - before.mesh.maps["normal"].images[0])[shown].mean() > 20
    out = sample(Sample(**options, count=1, variants=True, out=tmp_path / "both"))
    kept = read_with_maps(out / "variants.glb").mesh.maps
    for slot in ("normal", "metallic_roughness"):
        assert np.array_equal(kept[slot].images[0], before.mesh.maps[slot].images[0])


def test_a_mesh_without_instant_and_patches_without_a_mesh_are_refused(tmp_path, generator):
    with pytest.raises(ValueError) as refusal:
        sample(Sample(run=tmp_path / "bowl.glb"))
    where = tmp_path / "bowl.glb"
    remedy = f"add --instant to make textures without training, or train first: flx train {where}"
    assert str(refusal.value) == f"{where} is a mesh; {remedy}"
    with pytest.raises(ValueError) as refusal:
        sample(Sample(run=tmp_path, texture=Path("a.png")))
    assert str(refusal.value) == "texture a.png goes with --instant and a mesh file; leave it out"
    with pytest.raises(ValueError) as refusal:
        sample(Sample(run=tmp_path, instant=True, steps=50))
    assert str(refusal.value) == (
        "there is no network to evaluate with --instant; leave out --steps and --sampler"
    )
    with pytest.raises(ValueError) as refusal:
        sample(Sample(run=tmp_path, instant=True, seed=-1))
    assert str(refusal.value) == "--seed is -1; give at least 0"
    with pytest.raises(ValueError) as refusal:
        sample(Sample(run=tmp_path, patches=Patches(coherence=2.0)))
    assert str(refusal.value) == "coherence is 2.0, which goes with --instant; add that"
