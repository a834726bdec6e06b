"""Laws of the files that a mesh names: they are searched for in its folder, and nowhere else."""

import os
from pathlib import Path

import pytest
from helpers.cube import MTL, files, saved
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats import glb
from flx.assets.formats.files import found_beside
from flx.assets.formats.gltf import Gltf
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.commands.doctor import describe
from flx.config import Surface
from flx.training.run import Run
from flx.training.run_asset import keep

FOREIGN = (
    "C:\\Users\\Anna\\tex\\Grain.png",
    "/home/anna/grain.png",
    "\\\\server\\a\\grain.PNG",
    "GRAIN.png",
    ".\\GRAIN.png",
)


@pytest.mark.parametrize("name", FOREIGN)
@pytest.mark.parametrize("format", ["obj", "ply", "gltf"])
def test_an_image_named_by_another_machine_or_otherwise_in_capitals_is_found_and_told(tmp_path, name, format):
    """The file of that name next to the mesh is used, and the output names it correctly."""
    path = saved(tmp_path / "in", mtl=f"newmtl wood\nmap_Kd {name}\nmap_Bump {name}\n")
    Image.new("RGB", (8, 4), (10, 20, 30)).save(path.parent / "grain.png")
    if (path.parent / "GRAIN.png").exists() and "GRAIN" in name:
        pytest.skip("this disk does not tell capitals apart: the name is right as it is")
    if format == "ply":
        path = path.with_suffix(".ply")
        head = f"ply\nformat ascii 1.0\ncomment TextureFile {name}\nelement vertex 3\n"
        head += "".join(f"property float {k}\n" for k in "xyzst")
        head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        path.write_text(head + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n")
    elif format == "gltf":
        asset = read_asset(path)
        document, views = glb.build_gltf("a", asset.parts, asset.paints, {"base_color": {0: b""}})[:2]
        document["images"][0] = {"uri": name}
        path = path.with_suffix(".glb")
        path.write_bytes(glb.glb_bytes(Gltf(document, views)))
    asset = read_asset(path)
    assert (asset.mesh.textures[0] == [10, 20, 30]).all()
    assert asset.report.found_images == (f"'{name}' → grain.png",) and not asset.report.missing_images
    assert f"'{name}' → grain.png" in describe(asset.report)
    run = Run(tmp_path / "run")
    assert keep(asset, run, Surface(path=str(path))).digest == asset.digest
    if format == "obj":
        (tmp_path / "out").mkdir()
        write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out" / "new.obj")
        wanted = b"newmtl wood\nmap_Kd new_0.png\nmap_Bump grain.png\n"
        assert (tmp_path / "out" / "new.mtl").read_bytes() == wanted
        assert files(tmp_path / "out") == {"new.obj", "new.mtl", "new_0.png", "grain.png"}
        again = read_asset(tmp_path / "out" / "new.obj")
        assert again.digest == asset.digest and again.report.found_images == ()


def test_a_folder_may_be_in_capitals_too_but_two_files_are_one_too_many(tmp_path):
    path = saved(tmp_path, mtl=MTL.replace("textures/wood grain.png", "Textures\\Wood Grain.PNG"))
    asset = read_asset(path)
    assert asset.textures[0].name == "textures/wood grain.png"
    if (tmp_path / "textures" / "WOOD grain.png").exists():
        pytest.skip("this disk does not tell capitals apart: there cannot be two")
    (tmp_path / "textures" / "WOOD grain.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"'Textures\\Wood Grain\.PNG' does not exist; put it there, or"):
        read_asset(path)


@pytest.mark.parametrize(
    "name", ["OUT/secret.png", "../secret.png", "in/../../secret.png", "OUT/../secret.png"]
)
def test_no_folder_outside_is_even_listed(tmp_path, monkeypatch, name):
    (tmp_path / "secret.png").write_bytes(b"")
    (tmp_path / "mesh" / "in").mkdir(parents=True)
    (tmp_path / "mesh" / "out").symlink_to("..")
    listed, listdir = [], os.listdir
    monkeypatch.setattr(os, "listdir", lambda path: listed.append(Path(path).resolve()) or listdir(path))
    assert found_beside(tmp_path / "mesh", name) == ""
    assert listed and all(path.is_relative_to((tmp_path / "mesh").resolve()) for path in listed)
