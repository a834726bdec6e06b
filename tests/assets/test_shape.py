"""Laws of meshes to paint: none needs a texture, each is painted all over, and a bad one is one line."""

import numpy as np
import pytest
import trimesh
from helpers.files import MTL, colored_ball, gltf, obj, raw
from helpers.surfaces import square_grid

from flx.assets.asset import Painting
from flx.assets.formats.gltf import read_gltf
from flx.assets.read import read_asset
from flx.assets.shape import SIDE, read_shape
from flx.assets.write import write


def charted(text: str) -> str:
    """The tetrahedron with a quarter of the image for each face."""
    head = text[: text.index("vt 0 0")]
    rows = "".join(
        f"vt {u} {v}\nvt {u + 0.4} {v}\nvt {u} {v + 0.4}\n"
        for u, v in ((0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5))
    )
    corners = ((1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4))
    faces = [" ".join(f"{v}/{3 * n + k + 1}" for k, v in enumerate(face)) for n, face in enumerate(corners)]
    return f"{head}{rows}usemtl skin\n" + "".join(f"f {face}\n" for face in faces)


def red(asset) -> Painting:
    return Painting({"base_color": [np.full_like(i, (255, 0, 0)) for i in asset.mesh.textures]})


def test_a_gltf_without_an_image_keeps_its_bytes_and_loses_its_tint(tmp_path):
    def bare(d):
        d["materials"] = [{"name": "m", "pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 0.5]}}]
        d["images"], d["textures"], d["extras"] = [], [], {"kept": 1}
        d["nodes"][0]["name"] = "my node"
        d["accessors"][2]["count"] = 3  # one triangle: the four share texels

    asset = read_shape(gltf(bare)(tmp_path))
    assert [image.shape for image in asset.mesh.textures] == [(SIDE, SIDE, 3)]
    write(asset, red(asset), tmp_path / "out.glb")
    document = read_gltf(tmp_path / "out.glb").document
    assert document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] == [1, 1, 1, 0.5]
    assert document["nodes"][0]["name"] == "my node" and document["extras"] == {"kept": 1}
    assert (read_asset(tmp_path / "out.glb").mesh.textures[0] == (255, 0, 0)).all()


@pytest.mark.parametrize("image", [None, b"no image"], ids=["own", "broken"])
def test_an_obj_is_painted_whether_its_image_can_be_read_or_not(tmp_path, image):
    asset = read_shape(obj(charted, image=image)(tmp_path))
    assert (asset.container is None) == (image is not None)
    assert min(i.shape[0] for i in asset.mesh.textures) >= SIDE  # one of 4 × 4 pixels is enlarged
    write(asset, red(asset), tmp_path / "out.glb")
    assert (read_asset(tmp_path / "out.glb").mesh.textures[0] == (255, 0, 0)).all()


def test_every_material_is_painted(tmp_path):
    two = MTL + "newmtl flat\nKd 1 0 0\n"
    twice = obj(lambda t: charted(t).replace("f 2/10", "usemtl flat\nf 2/10"), two)
    asset = read_shape(twice(tmp_path))
    assert len(asset.textures) == 2 and not any(texture.flat for texture in asset.textures)


@pytest.mark.parametrize("kind", ["stl", "off"])
def test_triangles_alone_are_welded_and_get_charts(tmp_path, kind, capsys):
    pytest.importorskip("xatlas", reason="xatlas is not installed: pip install '.[uv]'")
    trimesh.Trimesh(*square_grid(4), process=False).export(tmp_path / f"a.{kind}")
    asset = read_shape(tmp_path / f"a.{kind}")
    assert (asset.report.vertices, asset.report.faces, len(asset.textures)) == (16, 18, 1)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "no texture coordinates, so it gets new charts" in said


def test_coordinates_that_are_of_no_use_are_made_anew(tmp_path, capsys):
    pytest.importorskip("xatlas", reason="xatlas is not installed: pip install '.[uv]'")
    point = obj(lambda t: t.replace("vt 1 0", "vt 0 0").replace("vt 0 1", "vt 0 0"))(tmp_path)
    assert "no area on its texture" in (read_shape(point) and capsys.readouterr().err)
    everywhere = obj(lambda t: t)(tmp_path)  # four faces on the same half of the image
    asset = read_shape(everywhere)
    assert "show several places, so it gets new charts" in capsys.readouterr().err
    assert asset.container is None


def test_without_xatlas_a_mesh_without_coordinates_is_refused_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    ball = colored_ball(tmp_path)
    with pytest.raises(ValueError, match=r"ball\.ply has no texture coordinates; pip install '\.\[uv\]' in"):
        read_shape(ball)
    assert not read_shape(ball, "ply").textures  # colours at its vertices


@pytest.mark.parametrize(
    ("build", "line"),
    [
        (raw("a.stl", b""), "is empty"),
        (raw("a.stl", b"solid a\nendsolid a\n"), "no triangles|cannot be read"),
        (raw("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\nnan 1 0\n3 0 1 2\n"), "not finite"),
        (raw("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n"), "cannot be read|vertex 9"),
        (raw("a.xyz", b"0 0 0"), r"not a mesh file; give one of .*\.stl"),
        (raw("a.obj", b"v 0 0 0\n"), "no triangles"),
    ],
)
def test_a_bad_mesh_to_paint_is_one_line(tmp_path, build, line):
    with pytest.raises(ValueError, match=line) as refusal:
        read_shape(build(tmp_path))
    assert "\n" not in str(refusal.value) and ";" in str(refusal.value)


def test_faces_over_the_limit_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("FLX_MAX_FACES", "10")
    trimesh.Trimesh(*square_grid(4), process=False).export(tmp_path / "a.stl")
    with pytest.raises(ValueError, match="18 faces, more than 10; decimate it"):
        read_shape(tmp_path / "a.stl")
