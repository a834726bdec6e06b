"""Laws of PLY: the same surface written in different ways is read as the same."""

import struct
from pathlib import Path

import numpy as np
import pytest
from helpers.files import PLY, corners, obj, ply_binary, png
from hypothesis import given
from hypothesis import strategies as st

from flx.assets.formats import ply as plies
from flx.assets.formats.ply import parse_ply
from flx.assets.read import read_asset

HEAD = PLY[: PLY.index("end_header")]


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


KINDS = {"uchar": "B", "ushort": "H", "int": "i", "float": "f", "double": "d"}
RANGES = {"uchar": 200, "ushort": 60_000, "int": 10**6, "float": 100, "double": 100}


@given(st.integers(0, 10**6))
def test_rows_of_any_lengths_are_read_as_one_by_one(seed):
    """Points between lists, behind an element that is not used; in pieces of a few bytes, too."""
    rng = np.random.default_rng(seed)
    order, name = [("<", "little"), (">", "big")][rng.integers(2)]
    counts, kinds = ["uchar", "ushort", "int"], list(KINDS)
    lists = [(rng.choice(counts), rng.choice(kinds), "") for _ in range(rng.integers(1, 4))]
    head, body, points = f"ply\nformat binary_{name}_endian 1.0\n", b"", []
    for element, length in (("junk", int(rng.integers(5))), ("vertex", 4)):
        head += f"element {element} {length}\n"
        fields: list = [*[("float", axis) for axis in "xyz"], *lists]
        fields = [fields[i] for i in rng.permutation(len(fields))]
        for i, field in enumerate(fields):
            words = f"list {field[0]} {field[1]} p{i}" if len(field) == 3 else " ".join(field)
            head += f"property {words}\n"
        for _ in range(length):
            for field in fields:
                kind, size = field[1] if len(field) == 3 else field[0], 1
                if len(field) == 3:
                    size = int(rng.integers(6))
                    body += struct.pack(order + KINDS[field[0]], size)
                values = rng.integers(0, RANGES[kind], size).tolist()
                body += struct.pack(f"{order}{size}{KINDS[kind]}", *values)
                if len(field) == 2 and element == "vertex":
                    points.append((field[1], *values))
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    body += struct.pack(f"{order}B3iB4i", 3, 0, 1, 2, 4, 0, 1, 2, 3)
    wanted = [[value for axis, value in points if axis == wished] for wished in "xyz"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plies, "PIECE", [1, 7, 1 << 18][rng.integers(3)], raising=False)
        part = parse_ply(head.encode() + body, "a").parts[0]
        assert part.positions.T.tolist() == wanted
        assert part.faces[0].tolist() == [0, 1, 2] and sorted(set(part.faces[1:].ravel())) == [0, 1, 2, 3]
        cut = rng.integers(1, len(body))
        with pytest.raises(ValueError, match=r"too short|cut off|no faces"):
            assert parse_ply(head.encode() + body[:-cut], "a").parts, "no faces"
