"""Laws of OBJ and PLY: the same surface written in different ways is read as the same; trimesh agrees."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.files import OBJ, PLY, obj, ply_binary, png
from hypothesis import given
from hypothesis import strategies as st

from flx.assets.formats.obj import fans, parse_obj
from flx.assets.formats.ply import parse_ply
from flx.assets.read import read_asset

HEAD = PLY[: PLY.index("end_header")]


def corners(parts) -> np.ndarray:
    """Positions, texture coordinates and colours of every corner of every face."""
    rows = []
    for part in parts:
        columns = [part.positions, part.uvs, part.normals, part.colors]
        rows.append(np.concatenate([c[part.faces] for c in columns if c is not None], -1))
    return np.concatenate(rows)


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


def test_ascii_and_both_byte_orders_are_one_file():
    big = HEAD.replace("ascii", "binary_big_endian").encode() + b"end_header\n"
    rows = [line.split() for line in PLY[PLY.index("end_header") :].splitlines()[1:]]
    big += b"".join(struct.pack(">fffBBB", *map(float, r[:3]), *map(int, r[3:])) for r in rows[:4])
    big += b"".join(struct.pack(">Biii", *map(int, r)) for r in rows[4:])
    wanted = corners(parse_ply(PLY.encode(), "a").parts)
    assert wanted.shape == (4, 3, 6)
    for content in (big, ply_binary(), PLY.replace("\n", "\r\n").encode()):
        assert np.array_equal(corners(parse_ply(content, "a").parts), wanted)


@pytest.mark.parametrize("binary", [False, True])
def test_triangles_and_quadrangles_may_mix_in_a_ply(binary):
    faces = [(0, 1, 2, 3), (0, 2, 1), (0, 3, 2, 1)]
    head = HEAD.replace("face 4", "face 3") + "end_header\n"
    points = PLY[PLY.index("end_header") + 11 :].splitlines()[:4]
    if binary:
        content = head.replace("ascii", "binary_little_endian").encode()
        for row in points:
            x, y, z, r, g, b = row.split()
            content += struct.pack("<fffBBB", float(x), float(y), float(z), int(r), int(g), int(b))
        content += b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    else:
        lines = [" ".join(map(str, (len(face), *face))) for face in faces]
        content = (head + "\n".join(points + lines) + "\n").encode()
    found = parse_ply(content, "a")
    assert found.polygons == 2
    assert found.parts[0].faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2], [0, 2, 1]]


def test_a_ply_of_corner_coordinates_and_two_textures(tmp_path: Path):
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(png())
    head = HEAD.replace(
        "element vertex", "comment TextureFile a.png\ncomment TextureFile b.png\nelement vertex"
    )
    head += "property list uchar float texcoord\nproperty int texnumber\nend_header\n"
    rows = PLY[PLY.index("end_header") + 11 :].splitlines()
    body = [*rows[:4], *(f"{row} 6 0 0 1 0 {k / 4} 1 {k % 2}" for k, row in enumerate(rows[4:]))]
    (tmp_path / "a.ply").write_text(head + "\n".join(body) + "\n")
    asset = read_asset(tmp_path / "a.ply")
    assert len(asset.mesh.textures) == 2 and asset.mesh.face_textures.tolist() == [0, 0, 1, 1]
    assert sorted(asset.mesh.corner_uvs[:, 2, 0].tolist()) == [0, 0.25, 0.5, 0.75]
    assert np.allclose(asset.mesh.corner_uvs[:, 0], [0, 1]) and np.allclose(asset.mesh.corner_uvs[:, 2, 1], 0)
    assert asset.report.vertices == 4 and asset.report.boundary_edges == 0


def test_a_texture_that_no_corner_knows_is_refused(tmp_path):
    path = obj(lambda text: text.replace("f 1/1 3/2 2/3", "f 1 3 2"))(tmp_path)
    with pytest.raises(ValueError, match="no texture coordinates"):
        read_asset(path)
