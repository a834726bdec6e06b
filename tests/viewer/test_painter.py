"""Laws of the painter: what it saves, flx reads as it was painted; what it cannot use is one line."""

import base64
import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from helpers.slab import SIDE, slab, texel_places
from helpers.surfaces import torus
from helpers.textured import noise
from PIL import Image

from flx.assets.arrays import from_arrays
from flx.geometry.atlas import fill_gutter
from flx.pipeline.direction import read_direction
from flx.pipeline.labels import read_labels
from flx.pipeline.masks import read_mask
from flx.viewer.drawings import own_drawing
from flx.viewer.painter import StrokePainter, TexelPainter

SIZE = SIDE, SIDE
LABELS = [
    {"name": "rest", "color": "#808080"},
    {"name": "left <b>", "color": "#e69f00"},
    {"name": "Blüte", "color": "#56B4E9"},
]


def painted() -> np.ndarray:
    """Nothing in the middle, label 1 on the left, label 2 on the right."""
    places, atlas = texel_places(slab())
    numbers = np.zeros(SIDE * SIDE, np.uint8)
    numbers[atlas.texels] = np.where(places[:, 0] < -0.3, 1, np.where(places[:, 0] > 0.3, 2, 0))
    return numbers.reshape(SIZE)


def body(numbers: np.ndarray, labels=LABELS) -> bytes:
    packed = base64.b64encode(zlib.compress(numbers.tobytes())).decode()
    return json.dumps({"labels": labels, "numbers": packed}).encode()


def test_labels_are_read_back_by_flx_with_no_border_between_charts(tmp_path):
    painter = TexelPainter(slab(), tmp_path / "labels.png", "labels", SIZE)
    assert painter.save(body(painted())).startswith("rest ") and "Blüte" in painter.saved
    image = Image.open(painter.out)
    colors = np.asarray(image.convert("RGB"))
    assert image.mode == "P" and len(np.unique(colors.reshape(-1, 3), axis=0)) == 3
    covered = painter.atlas.covered
    assert (fill_gutter(np.ascontiguousarray(colors), covered) == colors).all() and not covered.all()
    found = read_labels(painter.out, slab())
    order = {(128, 128, 128): 0, (0xE6, 0x9F, 0): 1, (0x56, 0xB4, 0xE9): 2}
    numbers = np.array([order[tuple(map(int, color))] for color in found.palette])[found.numbers]
    assert (numbers[covered] == painted()[covered]).mean() > 0.999


def test_what_was_saved_is_the_start_of_the_next_call_names_included(tmp_path):
    first = TexelPainter(slab(), tmp_path / "labels.png", "labels", SIZE)
    first.save(body(painted()))
    again = TexelPainter(slab(), first.out, "labels", SIZE, start=first.out)
    covered = again.atlas.covered
    assert (again.drawing.numbers == painted())[covered].all()
    assert [label.name for label in again.drawing.labels] == ["rest", "left <b>", "Blüte"]
    large = TexelPainter(slab(), first.out, "labels", (2 * SIDE, 2 * SIDE), start=first.out)
    assert (large.drawing.numbers[::2, ::2] == again.drawing.numbers).all()


def test_labels_of_another_program_can_be_gone_on_with(tmp_path):
    image = np.full((64, 64, 3), (200, 30, 30), np.uint8)
    image[:, 32:] = (30, 30, 200)
    Image.fromarray(image).save(tmp_path / "other.png")
    painter = TexelPainter(slab(), tmp_path / "labels.png", "labels", SIZE, start=tmp_path / "other.png")
    assert own_drawing(tmp_path / "other.png") is None
    assert [label.color for label in painter.drawing.labels] == ["#808080", "#1e1ec8", "#c81e1e"]
    assert (painter.drawing.numbers[:, : SIDE // 2] == 2).all()


def test_a_mask_is_white_where_something_is_kept(tmp_path):
    painter = TexelPainter(slab(), tmp_path / "keep.png", "keep", SIZE)
    numbers = (painted() == 1).astype(np.uint8)
    assert "keep" in painter.save(body(numbers, []))
    mask = read_mask(painter.out, SIZE)
    assert (mask == (numbers > 0))[painter.atlas.covered].all() and mask.sum() > numbers.sum() > 1000
    again = TexelPainter(slab(), painter.out, "keep", SIZE, start=painter.out)
    assert (again.drawing.numbers == mask).all()
    assert "nothing is kept yet" in painter.save(body(0 * numbers, []))


def test_strokes_are_read_back_as_a_direction(tmp_path):
    painter = StrokePainter(slab(), tmp_path / "strokes.json")
    strokes = [
        {"points": [[-0.5, 0, 0.015], [0.5, 0, 0.015]]},
        {"points": [[0, 0.2, 0.015]], "direction": [1, 0, 0]},
    ]
    assert painter.save(json.dumps({"strokes": strokes}).encode()) == "strokes: 2, with 3 points"
    first, second = read_direction(str(painter.out), slab())
    assert first.points.tolist() == strokes[0]["points"] and second.direction.tolist() == [1, 0, 0]
    assert StrokePainter(slab(), painter.out, start=painter.out).strokes == strokes


def unpacked(data, name: str, kind) -> np.ndarray:
    return np.frombuffer(zlib.decompress(base64.b64decode(data[name])), kind)


def test_faces_are_numbered_as_the_page_draws_them():
    """They go by where they lie: neighbours share an edge, owners show their texels, groups are compact."""
    ring = torus(60, 40)
    corners = ring.vertices[ring.faces]
    uvs = 0.25 + corners[..., :2] / 6 + (corners.mean(1)[:, 2] < 0)[:, None, None] * [0.5, 0]
    data = TexelPainter(from_arrays(*ring, uvs, noise(64, 64)), Path("x.png"), "labels", SIZE).data()
    positions = unpacked(data, "positions", np.float32).reshape(-1, 3)
    across = unpacked(data, "across", np.int32)
    for k, other in ((1, 2), (2, 1)):  # of a closed surface whose faces agree
        own, there = (c - c % 3 + (c + n) % 3 for c, n in ((np.arange(len(across)), k), (across, other)))
        assert (positions[own] == positions[there]).all()

    owners, uvs = unpacked(data, "owners", np.int32), unpacked(data, "uvs", np.float64).reshape(-1, 3, 2)
    texels = np.flatnonzero(owners >= 0)
    centres = (np.stack([texels % SIDE, texels // SIDE], 1) + 0.5) / SIDE
    low, high = uvs[owners[texels]].min(1), uvs[owners[texels]].max(1)
    assert len(texels) > 1000 and ((centres > low - 1 / SIDE) & (centres < high + 1 / SIDE)).all()

    groups = [np.arange(3 * g["start"], 3 * (g["start"] + g["count"])) for g in data["groups"]]
    assert (np.concatenate(groups) == np.arange(len(positions))).all() and len(groups) > 3
    assert max(np.ptp(positions[group], axis=0).max() for group in groups) < 1.3


def test_texels_that_several_places_show_are_said():
    flipped = slab().mesh.corner_uvs.copy()
    flipped[:] = flipped[:1]
    asset = slab()._replace(mesh=slab().mesh.with_layer(corner_uvs=flipped))
    (note,) = TexelPainter(asset, Path("x.png"), "labels", SIZE).notes
    assert "of the texels show several places" in note
    assert TexelPainter(slab(), Path("x.png"), "labels", SIZE).notes == []


@pytest.mark.parametrize(
    ("sent", "match"),
    [
        (b"\xff", "no JSON object"),
        (b"[1]", "no JSON object"),
        (body(painted(), LABELS[:1]), "labels are not a list of 2 to 32"),
        (body(painted(), [*LABELS[:2], {"name": " ", "color": "#123456"}]), "label 2 has no name"),
        (body(painted(), [*LABELS[:2], {"name": "x\n", "color": "#123456"}]), "label 2 has no name"),
        (body(painted(), [*LABELS[:2], {"name": "x", "color": "red"}]), "label 2, 'x', has no colour"),
        (body(painted(), [*LABELS[:2], {"name": "x", "color": "#E69F00"}]), "have one colour, #e69f00"),
        (body(painted(), LABELS[:2]), "a texel has label 2, but there are 2"),
        (body(painted()[1:]), "numbers are not 65,536 bytes"),
        (body(np.zeros((4 * SIDE, SIDE), np.uint8)), "numbers are not 65,536 bytes"),
        (json.dumps({"labels": LABELS, "numbers": "!"}).encode(), "not deflated bytes in base64"),
        (json.dumps({"labels": LABELS, "numbers": 3}).encode(), "not deflated bytes in base64"),
    ],
)
def test_what_cannot_be_saved_is_one_line_and_the_file_stays(tmp_path, sent, match):
    painter = TexelPainter(slab(), tmp_path / "labels.png", "labels", SIZE)
    painter.save(body(painted()))
    before = painter.out.read_bytes()
    with pytest.raises(ValueError, match=match) as fault:
        painter.save(sent)
    assert "\n" not in str(fault.value) and painter.out.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["labels.png"]


@pytest.mark.parametrize(
    ("texel", "tolerance"), [(None, 0.1), (-1, 0.1), (SIDE * SIDE, 0.1), (0, 2), (0, "x"), (0, 0.1)]
)
def test_a_fill_of_nothing_is_one_line(texel, tolerance):
    """The first texel lies between the charts."""
    answers = TexelPainter(slab(), Path("x.png"), "labels", SIZE).answers()
    with pytest.raises(ValueError, match=r"texel|tolerance"):
        answers["POST", "similar"](json.dumps({"texel": texel, "tolerance": tolerance}).encode())
