"""Laws of OBJ: the same surface written in different ways is read as the same; trimesh agrees."""

import numpy as np
import pytest
import trimesh
from helpers.files import OBJ, corners
from hypothesis import given
from hypothesis import strategies as st

from flx.assets.formats.obj import parse_obj
from flx.assets.formats.ply import parse_ply
from flx.assets.formats.polygons import fans


def test_relative_indices_count_from_their_own_line():
    lines = OBJ.splitlines()
    fourth, faces = lines.pop(lines.index("v 0 0 1")), [line for line in OBJ.splitlines() if line[0] == "f"]
    lines = [line for line in lines if line[0] != "f"]
    relative = [
        *lines,
        "f -3/-3 -1/-2 -2/-1",
        fourth,
        "f -4/1 -3/2 -1/3",
        "f -4/-3 -1/2 -2/-1",
        "f -3/1 -2/2 -1/3",
    ]
    absolute = [*lines, fourth, *faces]
    found, wanted = (parse_obj("\n".join(text), "a").parts for text in (relative, absolute))
    assert np.array_equal(corners(found), corners(wanted))


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda t: t.replace("\n", "\r\n"),
        lambda t: t.replace("\n", "\r"),
        lambda t: t.replace("v ", "v\t").replace("f ", "f\t "),
        lambda t: t.replace("f 1/1 3/2", "f 1/1 \\\n3/2"),
        lambda t: t.replace("v 0 1 0", "v 0 1 0 # up"),
        lambda t: t.replace("v 0 1 0", "  v 0.0e0 +1 -0 1.0"),
        lambda t: t.replace("vt 1 0", "vt 1 0 0"),
        lambda t: "# a\no thing\ng group\ns off\n" + t + "l 1 2\np 1\n",
    ],
)
def test_obj_has_many_spellings(rewrite):
    assert np.array_equal(corners(parse_obj(rewrite(OBJ), "a").parts), corners(parse_obj(OBJ, "a").parts))


@pytest.mark.parametrize("piece", [0, 1, 7, 60])
def test_lines_keep_their_numbers_wherever_the_text_is_cut(piece, monkeypatch):
    monkeypatch.setattr("flx.assets.formats.obj.PIECE", piece)
    text = OBJ.replace("f 1/1 2/2", "\n\nf 1/1 2/2")
    assert np.array_equal(corners(parse_obj(text, "a").parts), corners(parse_obj(OBJ, "a").parts))
    with pytest.raises(ValueError, match="line 14 names v 9"):
        parse_obj(text.replace("f 1/1 4/2", "f 9/1 4/2"), "a")


def test_corners_with_and_without_normals_may_mix():
    text = OBJ.replace("usemtl", "vn 0 0 1\nusemtl").replace("f 1/1 3/2 2/3", "f 1/1/1 3/2/1 2/3/1")
    part = parse_obj(text, "a").parts[0]
    assert part.normals is None and part.uvs is not None  # some have none: none is kept
    assert parse_obj(text.replace("1/1 2/2 4/3", "1//1 2//1 4//1"), "a").parts[0].uvs is None


@given(st.lists(st.integers(3, 9), min_size=1, max_size=6))
def test_fans_cover_convex_polygons(sizes):
    triangles, owners = fans(np.array(sizes))
    start = 0
    for polygon, size in enumerate(sizes):
        angles = 2 * np.pi * np.arange(size) / size
        own = triangles[owners == polygon] - start
        a, b, c = np.moveaxis(np.stack([np.cos(angles), np.sin(angles)], 1)[own], 1, 0)
        areas = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
        assert (areas > 0).all() and areas.sum() / 2 == pytest.approx(size / 2 * np.sin(2 * np.pi / size))
        start += size


def test_obj_colours_count_to_one_or_to_255():
    colors = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (51, 102, 204)]
    texts = []
    for scale in (1, 255):
        text = OBJ
        for line, color in zip(("v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1"), colors, strict=True):
            text = text.replace(line, f"{line} " + " ".join(str(c / scale) for c in color))
        texts.append(text)
    whole, unit = (parse_obj(text, "a").parts[0].colors for text in texts)
    assert np.allclose(whole, unit) and unit.max() == 1 and np.allclose(unit[-1], [0.2, 0.4, 0.8])


def test_real_scans_are_what_trimesh_reads(tmp_path):
    """A random triangle soup in OBJ and PLY, written by trimesh, read by both."""
    rng = np.random.default_rng(0)
    mesh = trimesh.Trimesh(rng.normal(size=(50, 3)), rng.integers(0, 50, (80, 3)), process=False)
    for suffix, parse in ((".obj", parse_obj), (".ply", parse_ply)):
        path = tmp_path / f"a{suffix}"
        mesh.export(path)
        part = parse(path.read_text() if suffix == ".obj" else path.read_bytes(), "a").parts[0]
        assert np.allclose(part.positions[part.faces], mesh.triangles, atol=1e-6)
