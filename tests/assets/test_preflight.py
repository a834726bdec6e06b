"""Laws of what is said before work starts: what a new file will lack, and what cannot be written."""

import numpy as np
import pytest
from helpers.scene import container, png, save
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.write import write


def test_what_an_obj_would_not_have_is_named_in_one_line(tmp_path, capsys):
    gltf = container(occlusion_shares=True)
    document = gltf.document
    document["images"][1]["name"] = "two\nlines"
    document["materials"][0]["pbrMetallicRoughness"] |= {"roughnessFactor": 0.7, "metallicFactor": 0}
    document["materials"][0]["emissiveFactor"] = [1, 1, 1]
    document["meshes"][0]["primitives"][0]["attributes"] |= {"TEXCOORD_1": 1, "TANGENT": 0}
    document |= {"extensionsUsed": ["KHR_texture_transform", "KHR_materials_sheen"], "cameras": [{}]}
    document["asset"]["copyright"] = "me"
    asset = read_asset(save(gltf, tmp_path / "a.glb"))
    told = "two lines, image 2, baseColorFactor, alphaMode, roughnessFactor, emissiveFactor, TEXCOORD_1, "
    told += "TANGENT, lines and points, cameras, KHR_materials_sheen, 2 nodes, copyright, extras"
    for format, said in (("glb", ""), ("obj", f"{asset.path}: {told} stay behind; --format glb keeps all\n")):
        check_output(asset, format, [tmp_path / f"out.{format}"])
        assert capsys.readouterr().err == said


@pytest.mark.parametrize("given", [False, True])
def test_a_file_that_is_not_there_and_is_still_named_is_told(tmp_path, capsys, given):
    """The base colour's image is replaced: it is named no more."""
    gltf = container()
    for image in range(3):
        if given or image == 2:
            gltf.document["images"][image] = {"uri": f"gone {image}.png"}
    (tmp_path / "a.png").write_bytes(png((1, 2, 3)))
    gltf.document["materials"][1]["pbrMetallicRoughness"]["baseColorTexture"]["index"] = 0
    asset = read_asset(save(gltf, tmp_path / "a.glb"), tmp_path / "a.png" if given else None)
    told = "gone 1.png, gone 2.png" if given else "gone 2.png"
    check_output(asset, "glb", [tmp_path / "out.glb"])
    assert capsys.readouterr().err == f"{asset.path}: missing, but named in the new file: {told}\n"
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    assert ", ".join(read_asset(tmp_path / "out.glb").report.missing_images) == told


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


def test_the_atlas_beside_a_mesh_overwrites_no_file_of_the_input(tmp_path):
    """An OBJ whose image has the name that the new atlas would get, and one that was given with --texture."""
    Image.new("RGB", (8, 4), (10, 20, 30)).save(tmp_path / "new.png")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    asset = read_asset(tmp_path / "a.obj", tmp_path / "new.png")
    with pytest.raises(ValueError, match=r"new\.png would overwrite a file of .*; name another --out"):
        check_output(asset, "glb", [tmp_path / "new.glb"])
    check_output(asset, "glb", [tmp_path / "other.glb"])
