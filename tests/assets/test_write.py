"""Laws of what is written: read back by another reader it is the same; a failed write leaves the old file."""

import resource
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.cube import CUBE, saved
from helpers.files import colored_ball
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats.gltf import read_gltf
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.write import (
    write,
    write_png,
)
from flx.geometry.sampling import surface_colors

# A tetrahedron; the first half shows an image that has alpha, the second another image, one face a colour.
OBJ = """mtllib m.mtl
v 0.1 0 0
v 1 0 0
v 0 1 0.30000000000000004
v 0 0 1.1
vt 0.1 0.2
vt 0.9 0.3
vt 0.4 0.75
o first
usemtl skin
f 1/1 3/2 2/3
f 1/2 2/1 4/3
o second
usemtl bone white
f 1/1 4/1 3/2
usemtl plain
f 2/1 3/3 4/2
"""
MTL = "newmtl skin\nmap_Kd a.png\nnewmtl bone white\nmap_Kd b.png\nnewmtl plain\nKd 0.2 0.4 0.6\n"


def textured(folder: Path) -> Path:
    Image.new("RGBA", (8, 4), (10, 20, 30, 77)).save(folder / "a.png")
    Image.fromarray(np.full((6, 6), 257 * 90, np.uint16)).save(folder / "b.png")
    (folder / "m.mtl").write_text(MTL)
    (folder / "mesh.obj").write_text(OBJ)
    return folder / "mesh.obj"


@pytest.mark.parametrize("block", [1, 7, 162])
def test_the_text_of_an_obj_is_the_same_wherever_its_rows_are_cut(tmp_path, monkeypatch, block):
    asset = read_asset(colored_ball(tmp_path))
    colors = np.zeros((asset.report.vertices_read, 3), np.float32)
    write(asset, Painting({}, colors), tmp_path / "whole.obj")
    monkeypatch.setattr("flx.assets.write.BLOCK", block)
    write(asset, Painting({}, colors), tmp_path / "cut.obj")
    text = (tmp_path / "whole.obj").read_text()
    assert text == (tmp_path / "cut.obj").read_text()
    assert text.count("\nv ") == text.count("\nvn ") == 162 and text.count("\nf ") == 320


def test_an_obj_is_read_back_with_the_same_corners_names_and_images(tmp_path):
    asset = read_asset(textured(tmp_path))
    rng = np.random.default_rng(0)
    new = [rng.integers(0, 256, (16, 8, 3), np.uint8) for _ in asset.textures]
    (tmp_path / "out").mkdir()
    write(asset, Painting({"base_color": new}), tmp_path / "out" / "new.obj")
    names = {"new.obj", "new.mtl", "new_0.png", "new_1.png"}  # none for the flat colour
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    again = read_asset(tmp_path / "out" / "new.obj")
    assert {p.name for p in again.paints} >= {"skin", "bone white", "plain"}

    def corners(a) -> np.ndarray:
        rows = [a.mesh.vertices[a.mesh.faces], a.mesh.corner_uvs]
        middle = surface_colors(a.mesh, atlas_points(a.mesh))  # which image each face shows
        return np.concatenate([*rows, np.repeat(middle[:, None], 3, 1)], -1).reshape(-1, 8)

    def atlas_points(mesh):
        from flx.types import SurfacePoints

        return SurfacePoints(np.arange(len(mesh.faces)), np.full((len(mesh.faces), 3), 1 / 3))

    order = [[t.name for t in asset.textures].index(n) for n in ("a.png", "b.png", "plain")]
    new[order[2]] = asset.mesh.textures[order[2]]  # a flat material keeps its colour
    expected = corners(asset._replace(mesh=asset.mesh.with_layer(images=tuple(new))))
    found = corners(again)
    by_place = [np.lexsort(np.round(rows, 9).T) for rows in (found, expected)]
    np.testing.assert_allclose(found[by_place[0]], expected[by_place[1]], atol=1e-12)
    np.testing.assert_array_equal(found[by_place[0], :3], expected[by_place[1], :3])
    alphas = {t.name: t.alpha for t in again.textures}
    assert (alphas["new_0.png"] == 77).all() and alphas["new_1.png"] is None


def test_a_glb_goes_out_as_an_obj_where_its_nodes_put_it(tmp_path):
    write(
        asset := read_asset(textured(tmp_path)),
        Painting({"base_color": asset.mesh.textures}),
        tmp_path / "a.glb",
    )
    moved = read_gltf(tmp_path / "a.glb")
    moved.document["nodes"][0]["translation"] = [1, 2, 3]
    from flx.assets.formats.glb import glb_bytes

    (tmp_path / "b.glb").write_bytes(glb_bytes(moved))
    source = read_asset(tmp_path / "b.glb")
    write(source, Painting({"base_color": source.mesh.textures}), tmp_path / "out.obj")
    there = read_asset(tmp_path / "out.obj").mesh
    assert there.vertices.min(0).tolist() == [1, 2, 3] and len(there.faces) == 4


def test_an_obj_made_of_a_glb_has_its_normals_and_names_each_thing_once(tmp_path):
    """No material that no face uses; as many names of parts as parts."""
    text = OBJ.replace("v 0 0 1.1", "v 0 0 1.1\nvn 0.6 0.8 0")
    text = "".join(
        " ".join([line.split()[0], *(f"{c}/1" for c in line.split()[1:])]) + "\n" if line[0] == "f" else line
        for line in text.splitlines(keepends=True)
    )
    textured(tmp_path).write_text(text)
    write(
        asset := read_asset(tmp_path / "mesh.obj"),
        Painting({"base_color": asset.mesh.textures}),
        tmp_path / "a.glb",
    )
    source = read_asset(tmp_path / "a.glb")
    source = source._replace(
        parts=tuple(p._replace(name=n) for p, n in zip(source.parts, "aab", strict=True))
    )
    (tmp_path / "out").mkdir()
    write(source, Painting({"base_color": source.mesh.textures}), tmp_path / "out" / "new.obj")
    lines = (tmp_path / "out" / "new.obj").read_text().splitlines()
    assert [line for line in lines if line[:2] == "o "] == ["o a", "o a_1", "o b"]
    library = (tmp_path / "out" / "new.mtl").read_text()
    assert library.count("newmtl") == 3 and "default" not in library
    for part in read_asset(tmp_path / "out" / "new.obj").parts:
        np.testing.assert_allclose(part.normals, [[0.6, 0.8, 0]] * len(part.positions), atol=1e-6)


@pytest.mark.parametrize("format", ["obj", "ply"])
def test_vertex_colours_are_read_back_by_trimesh(tmp_path, format):
    asset = read_asset(colored_ball(tmp_path))
    colors = np.random.default_rng(0).integers(0, 256, (162, 3)).astype(np.float32) / 255
    write(asset, Painting({}, colors), tmp_path / f"out.{format}")
    found = trimesh.load_mesh(tmp_path / f"out.{format}", process=False, maintain_order=True)
    np.testing.assert_array_equal(found.vertices, asset.parts[0].positions)
    np.testing.assert_array_equal(found.faces, asset.parts[0].faces)
    np.testing.assert_array_equal(found.visual.vertex_colors[:, :3], np.rint(colors * 255))
    np.testing.assert_allclose(found.vertex_normals, asset.parts[0].normals, atol=1e-6)
    again = read_asset(tmp_path / f"out.{format}")
    np.testing.assert_array_equal(again.mesh.vertices, asset.mesh.vertices)


@pytest.mark.parametrize("name", ["out.glb", "out.obj", "out.ply", "out.png"])
def test_a_write_that_fails_half_way_leaves_the_old_file_and_nothing_else(tmp_path, name):
    """The system itself breaks the write: no file may grow beyond 1,000 bytes."""
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    asset, path = read_asset(colored_ball(tmp_path / "in")), tmp_path / "out" / name
    path.write_bytes(b"old")
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    black = Painting({}, np.zeros((162, 3), np.float32))

    def write_it() -> None:
        write_png(path, noise) if path.suffix == ".png" else write(asset, black, path)

    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, old[1]))
    try:
        with pytest.raises(OSError):
            write_it()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert path.read_bytes() == b"old" and list((tmp_path / "out").iterdir()) == [path]
    write_it()
    assert len(path.read_bytes()) > 1000


def test_a_ply_is_not_written_from_textures(tmp_path):
    with pytest.raises(ValueError, match=r"mesh\.obj has textures.*--format glb or obj"):
        check_output(read_asset(textured(tmp_path)), "ply", [tmp_path / "out.ply"])


# --- unwrapping


@pytest.mark.parametrize(
    "says, factor, mode",
    [
        ("", None, "OPAQUE"),  # a picture's alpha that no material speaks of
        ("map_d {}", None, "BLEND"),
        ("map_d other.png", None, "OPAQUE"),
        ("d 1\nTr 1", None, "OPAQUE"),  # d is the specification's
        ("Tr 0.25", 0.75, "BLEND"),
        ("d -halo 0.5\nmap_d {}", 0.5, "BLEND"),
        ("d 7", None, "OPAQUE"),
        ("d nan", None, "OPAQUE"),
    ],
)
@pytest.mark.parametrize("alpha", [77, 255, 0])
def test_a_glb_is_as_opaque_as_the_materials_say(tmp_path, says, factor, mode, alpha):
    """Alpha of nothing between is a mask; of 255 it is none."""
    name = "textures/wood grain.png"
    path = saved(tmp_path, mtl=f"newmtl wood\nmap_Kd {name}\n{says.format(name)}\nnewmtl bone white\nd 0.5")
    image = Image.new("RGBA", (8, 4), (10, 20, 30, alpha))
    image.save(tmp_path / name)
    asset = read_asset(path)
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    wood, bone = read_gltf(tmp_path / "out.glb").document["materials"]  # none for the faces there are not
    wanted = {77: mode, 255: "BLEND" if factor else "OPAQUE", 0: "MASK" if mode == "BLEND" else mode}[alpha]
    assert wood.get("alphaMode", "OPAQUE") == ("BLEND" if factor else wanted)
    assert wood["pbrMetallicRoughness"].get("baseColorFactor") == (factor and [1, 1, 1, factor])
    assert bone["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 0.5] and bone["alphaMode"] == "BLEND"


@pytest.mark.parametrize("more, name", [("", "cube"), ("\no second\n", "mesh"), ("\no cube\n", "cube")])
def test_a_glb_is_called_like_the_one_object_of_an_obj(tmp_path, more, name):
    path = saved(tmp_path, CUBE + more).rename(tmp_path / "mesh.obj")
    asset = read_asset(path)
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    document = read_gltf(tmp_path / "out.glb").document
    assert document["nodes"][0]["name"] == document["meshes"][0]["name"] == name
