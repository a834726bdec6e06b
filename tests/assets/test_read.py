"""Laws of the door: the file's own geometry goes out as it came in, and every fault has one line."""

import io
import json
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from helpers.files import PLY, obj
from PIL import ExifTags, Image

from flx.assets.asset import Asset, Painting
from flx.assets.formats.gltf import accessor, read_gltf
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.commands.doctor import describe

# A tetrahedron whose second half has another material; v/vt differ, so that texture seams split vertices.
OBJ = """mtllib m.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1.1
vt 0.1 0.2
vt 0.9 0.3
vt 0.4 0.75
vt 0.3 0.3
usemtl skin
f 1/1 3/2 2/3
f 1/2 2/1 4/3
usemtl bone white
f 1/4 4/1 3/2
f 2/1 3/3 4/4
"""
MTL = "newmtl skin\nKd 1 0 0\nmap_Kd -s 1 1 1 a.png\nnewmtl bone white\nKd 0.2 0.4 0.6\n"


def save_obj(folder: Path, obj: str = OBJ, mtl: str = MTL) -> Path:
    Image.new("RGB", (8, 4), (10, 20, 30)).save(folder / "a.png")
    (folder / "m.mtl").write_text(mtl)
    (folder / "mesh.obj").write_text(obj)
    return folder / "mesh.obj"


def read_back(path: Path) -> list[dict[str, np.ndarray]]:
    gltf = read_gltf(path)
    return [
        {name: accessor(gltf, i) for name, i in (p["attributes"] | {"indices": p["indices"]}).items()}
        for p in gltf.document["meshes"][0]["primitives"]
    ]


def obj_corners(text: str) -> dict[str, list]:
    """A second OBJ reader: for each material the (x, y, z, u, 1 − v) of every corner, in order."""
    v, vt, corners, material = [], [], {}, ""
    for key, *values in (line.split(" ") for line in text.splitlines()):
        if key == "v":
            v.append([float(x) for x in values])
        elif key == "vt":
            vt.append([float(values[0]), 1 - float(values[1])])
        elif key == "usemtl":
            material = " ".join(values)
        elif key == "f":
            for value in values:
                a, b = (int(x) - 1 for x in value.split("/"))
                corners.setdefault(material, []).append(v[a] + vt[b])
    return corners


def test_obj_goes_out_with_its_own_arrays_and_materials(tmp_path):
    asset = read_asset(save_obj(tmp_path))
    new = [np.full((6, 6, 3), 99, np.uint8), np.zeros((4, 4, 3), np.uint8)]
    write(asset, Painting({"base_color": new}), tmp_path / "out.glb")
    expected, document = obj_corners(OBJ), read_gltf(tmp_path / "out.glb").document
    names = [m["name"] for m in document["materials"]]
    seen = set()
    for primitive, arrays in zip(
        document["meshes"][0]["primitives"], read_back(tmp_path / "out.glb"), strict=True
    ):
        name = names[primitive["material"]]
        seen.add(name)
        rows = np.concatenate([arrays["POSITION"], arrays["TEXCOORD_0"]], 1)[arrays["indices"][:, 0]]
        assert np.array_equal(rows, np.float32(expected[name]))
    assert seen == {"skin", "bone white"}
    again = read_asset(tmp_path / "out.glb")
    assert np.array_equal(again.mesh.textures[0], new[0])
    # A material without an image keeps its colour: a factor, no texture, and no replacement.
    assert "baseColorTexture" not in document["materials"][1]["pbrMetallicRoughness"]
    assert np.array_equal(again.mesh.textures[1], asset.mesh.textures[1])
    assert tuple(asset.mesh.textures[1][0, 0]) == (51, 102, 153) and asset.textures[1].flat


def test_seams_are_welded_and_corners_keep_their_coordinates(tmp_path):
    asset = read_asset(save_obj(tmp_path))
    mesh, report = asset.mesh, asset.report
    assert (report.vertices, report.faces, report.euler, report.boundary_edges) == (4, 4, 2, 0)
    assert report.vertices_read - report.welded_vertices == 4 and report.welded_vertices > 0
    ours = np.concatenate([mesh.vertices[mesh.faces], mesh.corner_uvs], -1).reshape(-1, 5)
    assert np.allclose(
        np.sort(ours, 0), np.sort(np.concatenate(list(obj_corners(OBJ).values())), 0), atol=1e-15
    )
    stacked = np.concatenate([part.positions for part in asset.parts])
    assert np.array_equal(stacked[asset.corner_vertices], mesh.vertices[mesh.faces])
    by_material = {asset.textures[t].name: int((mesh.face_textures == t).sum()) for t in (0, 1)}
    assert by_material == {"a.png": 2, "bone white": 2}


def test_the_report_is_json_and_text(tmp_path):
    report = read_asset(save_obj(tmp_path)).report
    assert json.loads(json.dumps(report._asdict()))["welded_vertices"] == report.welded_vertices
    text = describe(report)
    assert "welded" in text and "8 × 4" in text and "duplicates" not in text


def test_a_given_texture_takes_the_place_of_a_missing_one(tmp_path):
    path = save_obj(tmp_path)
    Image.new("L", (5, 3), 77).save(tmp_path / "other.png")
    (tmp_path / "a.png").unlink()
    with pytest.raises(ValueError, match=r"'a\.png' does not exist.*--texture"):
        read_asset(path)
    asset = read_asset(path, tmp_path / "other.png")
    assert asset.mesh.textures[0].shape == (3, 5, 3) and (asset.mesh.textures[0] == 77).all()
    assert asset.textures[1].flat
    (tmp_path / "m.mtl").unlink()
    with pytest.raises(ValueError, match=r"m\.mtl does not exist.*--texture"):
        read_asset(path)
    asset = read_asset(path, tmp_path / "other.png")  # no material says otherwise: it is for all of them
    assert len(asset.textures) == 1 and {p.name for p in asset.paints} >= {"skin", "bone white"}


def test_one_image_cannot_replace_two(tmp_path):
    path = save_obj(tmp_path, mtl=MTL + "map_Kd b.png\n")
    Image.new("RGB", (2, 2)).save(tmp_path / "b.png")
    assert len(read_asset(path).mesh.textures) == 2
    with pytest.raises(ValueError, match="2 base colour images"):
        read_asset(path, tmp_path / "b.png")


def test_vertex_colours_of_a_ply_come_back_from_a_glb(tmp_path):
    (tmp_path / "a.ply").write_text(PLY)
    asset = read_asset(tmp_path / "a.ply")
    assert asset.report.color_source == "vertex colours" and asset.mesh.textures == ()
    file_colors = np.float32([[255, 0, 0], [0, 255, 0], [0, 0, 255], [9, 99, 199]]) / 255
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    assert np.allclose(asset.mesh.corner_colors, file_colors[faces])
    colors = np.random.default_rng(0).uniform(size=(4, 3)).astype(np.float32)
    write(asset, Painting({}, colors), tmp_path / "out.glb")
    again = read_asset(tmp_path / "out.glb")
    assert np.allclose(again.mesh.corner_colors, colors[faces], atol=1e-6)
    assert np.array_equal(again.mesh.vertices[again.mesh.faces], asset.mesh.vertices[asset.mesh.faces])
    with pytest.raises(ValueError, match="3 colours for the 4 vertices"):
        write(asset, Painting({}, colors[:3]), tmp_path / "out.glb")
    with pytest.raises(ValueError, match="1 images for the 0 base_color images"):
        write(asset, Painting({"base_color": [np.zeros((2, 2, 3), np.uint8)]}), tmp_path / "out.glb")


def test_a_ply_with_a_texture_file(tmp_path):
    Image.new("RGB", (2, 2), (1, 2, 3)).save(tmp_path / "t.png")
    text = PLY.replace("format ascii 1.0", "format ascii 1.0\ncomment TextureFile t.png")
    for old, new in (("uchar red", "float s"), ("uchar green", "float t"), ("property uchar blue\n", "")):
        text = text.replace(old, new)
    for old, new in (
        ("255 0 0\n", "0 0\n"),
        ("0 255 0\n", "1 0\n"),
        ("0 0 255\n", "0 1\n"),
        ("9 99 199\n", ".5 .25\n"),
    ):
        text = text.replace(old, new)
    (tmp_path / "a.ply").write_text(text)
    asset = read_asset(tmp_path / "a.ply")
    assert (asset.mesh.textures[0] == [1, 2, 3]).all()
    assert np.allclose(asset.mesh.corner_uvs[3], [[1, 1], [0, 0], [0.5, 0.75]])


@pytest.mark.parametrize(
    "mode, told",
    [
        ("RGB", ""),
        ("RGBA", ""),
        ("L", "grey"),
        ("LA", "grey"),
        ("P", "palette"),
        ("1", "black and white"),
        ("I;16", "16-bit grey"),
        ("16-bit RGB", "16-bit RGB"),
    ],
)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_an_image_that_was_not_8_bit_rgb_is_told_in_the_report(tmp_path, mode, told, suffix):
    path = save_obj(tmp_path, mtl=MTL.replace("a.png", f"b.{suffix}"))
    if mode == "16-bit RGB":
        rows = np.full((3, 4, 3), 257 * 90, np.uint16)
        if suffix == "tif":
            tifffile.imwrite(tmp_path / "b.tif", rows.transpose(2, 0, 1), photometric="rgb", planarconfig=2)
            with pytest.raises(ValueError, match=r"b\.tif' is a TIFF of 16-bit planes; save it as PNG"):
                read_asset(path)
            tifffile.imwrite(tmp_path / "b.tif", rows, photometric="rgb")
        else:
            write_png_of_16_bits(tmp_path / "b.png", rows)
    elif mode == "I;16":
        Image.fromarray(np.full((3, 4), 257 * 200, np.uint16)).save(tmp_path / f"b.{suffix}")
    else:
        Image.new(mode, (4, 3)).save(tmp_path / f"b.{suffix}")
    found = read_asset(path).report.textures[0]
    assert found == f"b.{suffix}: 4 × 3" + (f", made from {told}" if told else "")
    assert found in describe(read_asset(path).report)


def write_png_of_16_bits(path: Path, rows: np.ndarray) -> None:
    """Pillow has no such image."""
    height, width = rows.shape[:2]
    data = b"".join(b"\0" + row.astype(">u2").tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(data)), (b"IEND", b"")):
        content += struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    path.write_bytes(content)


def test_the_digest_follows_content_not_place(tmp_path):
    (tmp_path / "b").mkdir()
    path = save_obj(tmp_path)
    first = read_asset(path).digest
    assert read_asset(save_obj(tmp_path / "b")).digest == first
    Image.new("RGB", (8, 4), (10, 20, 31)).save(tmp_path / "a.png")
    assert read_asset(path).digest != first
    assert read_asset(save_obj(tmp_path / "b", OBJ.replace("1.1", "1.2"))).digest != first


@pytest.mark.parametrize(
    "spoil, match",
    [
        (lambda t: "", "is empty"),
        (lambda t: "v 0 0 0\n", "no triangles"),
        (lambda t: t.replace("f 1/1", "f 0/1"), "line 11 names v 0, but OBJ counts from 1"),
        (lambda t: t.replace("f 1/1", "f 99/1"), "line 11 names v 99, but there are 4"),
        (lambda t: t.replace("vt 0.9", "vt nan"), "not finite"),
        (lambda t: t.replace("f 1/1", "f -5/1"), "names v -5"),
        (lambda t: t.replace("vt 0.9", "vt o.9"), "'o.9' is not a number"),
        (
            lambda t: t.replace("f 1/1 3/2 2/3", "f 1 3 2").replace("f 1/2 2/1 4/3", "f 1 2 4"),
            "no texture coordinates",
        ),
        (lambda t: t.replace("m.mtl", "../m.mtl"), "outside"),
        (lambda t: t.replace("v 0 0 0", "v nan 0 0").replace("v 1 0 0", "v inf 0 0"), "vertex 0.*not finite"),
    ],
)
def test_a_spoilt_obj_is_one_line_that_names_it(tmp_path, spoil, match):
    path = save_obj(tmp_path)
    assert read_asset(path)
    path.write_text(spoil(OBJ))
    with pytest.raises(ValueError, match=match) as caught:
        read_asset(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_paths_that_are_no_mesh(tmp_path):
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_asset(tmp_path / "gone.obj")
    (tmp_path / "a.zip").write_bytes(b"PK")
    (tmp_path / "d.obj").mkdir()
    for path in (tmp_path / "a.zip", tmp_path / "d.obj", tmp_path):
        with pytest.raises(ValueError, match="not a mesh file"):
            read_asset(path)


def test_an_image_beside_a_mesh_that_names_none_is_proposed(tmp_path):
    path = save_obj(tmp_path, OBJ.replace("mtllib", "# no"))
    with pytest.raises(ValueError, match=rf"; pass --texture {tmp_path}/a.png, which lies here$"):
        read_asset(path)
    assert read_asset(path, tmp_path / "a.png").textures
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes())
    (tmp_path / "a.png").rename(tmp_path / "c.png")
    with pytest.raises(ValueError, match=r"; pass --texture IMAGE$"):  # which of the two?
        read_asset(path)


def test_without_texture_coordinates_no_texture_is_asked_for(tmp_path):
    bare = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    path = save_obj(tmp_path, bare)
    for texture in (None, tmp_path / "a.png"):
        with pytest.raises(ValueError, match="no texture coordinates; unwrap it in a 3D program") as told:
            read_asset(path, texture)
        assert "--texture" not in str(told.value)


@pytest.mark.parametrize(
    ("name", "told"),
    [("a.stl", "flx sample RUN --mesh"), ("A.STL", "triangles alone"), ("a.fbx", "export it as GLB")],
)
def test_other_formats_are_answered_with_what_to_do(tmp_path, name, told):
    (tmp_path / name).write_bytes(b"solid")
    with pytest.raises(ValueError, match=told):
        read_asset(tmp_path / name)


@pytest.mark.parametrize(
    "content, match", [(b"no image", "no known kind"), (None, "broken"), ("big", "9000 × 9000")]
)
def test_a_spoilt_image_is_named(tmp_path, content, match):
    path = save_obj(tmp_path)
    if content == "big":
        Image.new("1", (9000, 9000)).save(tmp_path / "a.png")
    elif content is None:
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)).save(
            tmp_path / "a.png"
        )
        (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:2000])
    else:
        (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(ValueError, match=rf"a\.png.*{match}"):
        read_asset(path)


# --------------------------------------------------------------------------------------------- real data


def real_folders() -> list[str]:
    root = Path(os.environ.get("FLX_DATA", "")) / "meshes"
    return sorted(p.parent.name for p in root.glob("*/info.json")) if "FLX_DATA" in os.environ else ["unset"]


@pytest.fixture(params=real_folders())
def real(request, tmp_path) -> tuple[Asset, dict]:
    """A real mesh, with a small texture in the place of its own: decoding 4096² is not what is tested."""
    if request.param == "unset":
        pytest.skip("FLX_DATA is not set: it names a folder with meshes/*/info.json")
    folder = Path(os.environ["FLX_DATA"]) / "meshes" / request.param
    info = json.loads((folder / "info.json").read_text())
    Image.new("RGB", (4, 4)).save(tmp_path / "small.png")
    return read_asset(folder / info["mesh"], tmp_path / "small.png"), info["stats"]


def test_real_meshes_have_the_counts_that_were_measured(real):
    asset, stats = real
    report = asset.report
    assert report.vertices_read - report.welded_vertices == stats["v_welded"]
    assert (report.faces_read, report.degenerate_faces) == (stats["f"], stats["degenerate"])
    assert report.components == stats["comps"]
    assert (report.ear_faces > 0) == (stats["nonman"] > 0)
    # Every one of them is closed once the ears are gone; an ear adds 1 to V − E + F.
    assert (report.boundary_edges, report.split_vertices) == (0, 0)
    assert report.euler == stats["euler"] - report.ear_faces // 2
    stacked = np.concatenate([part.positions for part in asset.parts])
    assert np.array_equal(stacked[asset.corner_vertices], asset.mesh.vertices[asset.mesh.faces])


@pytest.mark.parametrize(("kind", "told"), [("JPEG", True), ("PNG", True), ("WEBP", True), ("TIFF", False)])
def test_an_image_that_exif_data_turn_is_taken_as_stored_and_told(tmp_path, kind, told):
    """Except of a TIFF, whose own tag it is."""
    pixels = np.repeat(np.repeat(np.array([[[255, 0, 0]], [[0, 0, 255]]], np.uint8), 8, 0), 8, 1)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # a quarter turn
    content = io.BytesIO()
    Image.fromarray(pixels).save(content, kind, exif=exif)
    asset = read_asset(obj(image=content.getvalue())(tmp_path))
    as_stored = asset.mesh.textures[0].shape == (16, 8, 3)
    assert as_stored == told == asset.textures[0].turned
    assert ("EXIF turns it" in asset.report.textures[0]) == told
    assert not read_asset(obj()(tmp_path)).textures[0].turned
