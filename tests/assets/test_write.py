"""Laws of what is written: read back by another reader it is the same; a failed write leaves the old file."""

import resource
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.surfaces import icosphere
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats.gltf import read_gltf
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.unwrap import is_unwrappable, prepared_for, unwrapped
from flx.assets.write import write, write_png
from flx.geometry.atlas import atlas_texels
from flx.geometry.sampling import surface_colors
from flx.geometry.seams import seam_ratio

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


def colored(folder: Path) -> Path:
    """A sphere with smooth vertex colours and normals, as PLY."""
    vertices, faces = icosphere(2)
    colors = np.rint(127 * (vertices + 1)).astype(np.uint8)
    mesh = trimesh.Trimesh(vertices.astype(np.float32), faces, vertex_colors=colors, process=False)
    (folder / "ball.ply").write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True))
    return folder / "ball.ply"


@pytest.mark.parametrize("block", [1, 7, 162])
def test_the_text_of_an_obj_is_the_same_wherever_its_rows_are_cut(tmp_path, monkeypatch, block):
    asset = read_asset(colored(tmp_path))
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
    asset = read_asset(colored(tmp_path))
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
    asset, path = read_asset(colored(tmp_path / "in")), tmp_path / "out" / name
    path.write_bytes(b"old")
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    writers = {
        ".glb": lambda: write(asset, Painting({}, np.zeros((162, 3), np.float32)), path),
        ".obj": lambda: write(asset, Painting({}, np.zeros((162, 3), np.float32)), path),
        ".ply": lambda: write(asset, Painting({}, np.zeros((162, 3), np.float32)), path),
        ".png": lambda: write_png(path, noise),
    }
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, old[1]))
    try:
        with pytest.raises(OSError):
            writers[path.suffix]()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert path.read_bytes() == b"old" and list((tmp_path / "out").iterdir()) == [path]
    writers[path.suffix]()
    assert len(path.read_bytes()) > 1000


def test_a_ply_is_not_written_from_textures(tmp_path):
    with pytest.raises(ValueError, match=r"mesh\.obj has textures.*--format glb or obj"):
        check_output(read_asset(textured(tmp_path)), "ply", [tmp_path / "out.ply"])


def test_what_a_new_ply_will_not_have_is_named_in_one_line(tmp_path, capsys):
    head = ["ply", "format ascii 1.0", "comment hi", "obj_info there", "element vertex 4"]
    head += [f"property float {name}" for name in ("x", "y", "z", "quality", "s", "t")]
    head += [f"property uchar {name}" for name in ("red", "green", "blue", "alpha")]
    head += ["element face 1", "property list uchar int vertex_indices", "property int flags"]
    head += ["element edge 1", "property int vertex1", "end_header"]
    rows = [f"{x} {y} 0 0.5 {x} {y} 9 99 199 7" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    (tmp_path / "a.ply").write_text("\n".join([*head, *rows, "4 0 1 2 3 5", "0", ""]))
    asset = read_asset(tmp_path / "a.ply")
    told = "1 polygon, vertex quality, vertex alpha, face flags, 1 × edge, 2 comments"
    for format, more in (("ply", ", ASCII text, texture coordinates"), ("glb", ""), ("obj", "")):
        check_output(asset, format, [tmp_path / f"out.{format}"])
        assert capsys.readouterr().err == f"{asset.path}: {told}{more} stay behind\n"
    write(asset, Painting({}, np.zeros((4, 3), np.float32)), tmp_path / "out.ply")
    check_output(read_asset(tmp_path / "out.ply"), "ply", [tmp_path / "b.ply"])
    assert capsys.readouterr().err == ""


# --- unwrapping


def test_without_xatlas_one_line_says_how_to_install_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    asset = read_asset(colored(tmp_path))
    with pytest.raises(ValueError, match=r"ball\.ply has no texture coordinates; pip install '\.\[uv\]' in"):
        unwrapped(asset)
    assert prepared_for(asset, "ply") is asset and capsys.readouterr().err == ""
    assert prepared_for(asset, "glb") is asset
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "pip install '.[uv]'" in said


@pytest.mark.parametrize("through_a_run", [False, True])
def test_an_unwrapped_mesh_shows_its_vertex_colours_on_the_same_triangles(tmp_path, through_a_run):
    pytest.importorskip("xatlas", reason="xatlas is not installed: pip install '.[uv]'")
    asset = first = read_asset(colored(tmp_path))
    if through_a_run:  # a run keeps its asset as a GLB
        write(first, Painting({}, first.parts[0].colors), tmp_path / "run.glb")
        asset = read_asset(tmp_path / "run.glb")
    assert is_unwrappable(asset)
    charted = prepared_for(asset, "glb")
    assert not is_unwrappable(charted) and charted.digest == asset.digest
    atlas = atlas_texels(charted.mesh, 0, *charted.mesh.textures[0].shape[:2])
    assert len(np.unique(atlas.faces)) == len(asset.mesh.faces) + 1  # every face, and the gutter
    write(charted, Painting({"base_color": charted.mesh.textures}), tmp_path / "out.glb")
    again = read_asset(tmp_path / "out.glb")
    np.testing.assert_allclose(
        again.mesh.vertices[again.mesh.faces], asset.mesh.vertices[asset.mesh.faces], atol=1e-7
    )
    points = atlas.points
    seen, wanted = surface_colors(again.mesh, points), surface_colors(asset.mesh, points)
    assert np.ptp(wanted) > 0.8 and np.abs(seen - wanted).max() < 2 / 255
    assert seam_ratio(again.mesh) == pytest.approx(1, abs=0.3)
    primitive = read_gltf(tmp_path / "out.glb").document["meshes"][0]["primitives"][0]
    assert set(primitive["attributes"]) == {"POSITION", "NORMAL", "TEXCOORD_0"}
