"""Laws of an OBJ that comes out as the same OBJ: which bytes change, which files go along, which never do."""

import os
from pathlib import Path

import numpy as np
import pytest
from helpers.cube import CUBE, MTL, changed, colored, files, new_images, same_bits, saved
from PIL import Image

from flx.assets.asset import Painting
from flx.assets.formats.obj_source import ObjSource, write_copy
from flx.assets.preflight import check_output
from flx.assets.read import read_asset
from flx.assets.unwrap import prepared_for
from flx.assets.write import check_room, write


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"], ids=["LF", "CRLF", "CR"])
def test_two_lines_change_and_all_files_go_along(tmp_path, end):
    asset = read_asset(saved(tmp_path / "in", end=end))
    path = tmp_path / "out" / "new.obj"
    path.parent.mkdir()
    images = new_images(asset)
    write(asset, Painting({"base_color": images}), path)
    e = end.encode()
    assert changed(asset.path, path) == [(b"mtllib my cube.mtl" + e, b"mtllib new.mtl" + e)]
    was, now = b"map_Kd -clamp on -s 1 1 1 textures/wood grain.png", b"map_Kd -clamp on -s 1 1 1 new_0.png"
    assert changed(tmp_path / "in" / "my cube.mtl", path.with_suffix(".mtl")) == [(was + e, now + e)]
    kept = {"wood grain.png", "bump.png", "normal.tga", "unused.jpg"}  # the first for map_Ks
    assert files(path.parent) == {"new.obj", "new.mtl", "new_0.png", *(f"textures/{name}" for name in kept)}
    for name in kept:
        there, here = (folder / "textures" / name for folder in (tmp_path / "in", path.parent))
        assert there.read_bytes() == here.read_bytes()
    again = read_asset(path)
    assert same_bits(asset, again) and again.digest != asset.digest
    np.testing.assert_array_equal(again.mesh.textures[0], images[0])
    np.testing.assert_array_equal(again.mesh.textures[1], asset.mesh.textures[1])  # flat stays
    assert (again.textures[0].alpha == 77).all()
    assert again.report.polygons == asset.report.polygons == 5
    write(
        asset, Painting({"base_color": asset.mesh.textures}), path
    )  # its own colours: the same mesh altogether
    assert read_asset(path).digest == asset.digest


def test_what_it_says_of_files_and_options_is_in_the_report(tmp_path):
    report = read_asset(saved(tmp_path / "in")).report
    assert report.missing_images == ("gone.png",)
    assert report.ignored_options == ("wood: -clamp on",)


def test_several_variations_in_one_folder_share_the_maps(tmp_path):
    asset = read_asset(saved(tmp_path / "in"))
    (tmp_path / "out").mkdir()
    paths = [tmp_path / "out" / f"variation_{n:02d}.obj" for n in range(2)]
    for path in paths:
        write(asset, Painting({"base_color": new_images(asset)}), path)
        time = (tmp_path / "out" / "textures" / "bump.png").stat().st_mtime_ns
    check_output(asset, "obj", paths)
    assert time == (tmp_path / "out" / "textures" / "bump.png").stat().st_mtime_ns
    assert all(same_bits(read_asset(path), asset) for path in paths)
    (tmp_path / "out" / "textures" / "bump.png").write_bytes(b"of somebody else")
    for refused in (
        lambda: check_room(asset, paths[0]),
        lambda: write(asset, Painting({"base_color": new_images(asset)}), paths[0]),
    ):
        with pytest.raises(ValueError, match=r"bump\.png exists and differs from the map.*--out"):
            refused()


def test_nothing_of_the_input_is_overwritten(tmp_path):
    path = saved(tmp_path / "in")
    (path.parent / "cube_0.png").write_bytes((path.parent / "textures" / "bump.png").read_bytes())
    mtl = MTL + "map_Ke cube_0.png\nmap_Ka textures/cube_0.png\n"
    (path.parent / "my cube.mtl").write_text(mtl)
    asset = read_asset(path)
    before = {name: (path.parent / name).read_bytes() for name in files(path.parent)}
    (path.parent / "link.obj").symlink_to("cube.obj")
    for name in ("cube.obj", "my cube.obj", "link.obj", "textures/../cube.obj"):
        with pytest.raises(ValueError, match=r"would overwrite a file of .*cube\.obj; name another --out"):
            write(asset, Painting({"base_color": asset.mesh.textures}), path.parent / name)
    (path.parent / "link.obj").unlink()
    write(
        asset, Painting({"base_color": asset.mesh.textures}), path.parent / "fresh.obj"
    )  # beside them is safe
    assert read_asset(path.parent / "fresh.obj").digest == asset.digest
    new = {name: (path.parent / name).read_bytes() for name in files(path.parent)}
    assert before.items() <= new.items() and new.keys() - before.keys() == {
        "fresh.obj",
        "fresh.mtl",
        "fresh_0.png",
    }
    with pytest.raises(ValueError, match=r"bump\.png would overwrite"):
        check_room(asset, path.parent / "fresh.obj", [path.parent / "textures" / "bump.png"])


def test_a_new_image_is_not_called_like_a_map_that_goes_along(tmp_path):
    path = saved(tmp_path / "in", mtl=MTL.replace("gone.png", "new_0.png"))
    (path.parent / "new_0.png").write_bytes(b"an old map")
    asset = read_asset(path)
    (tmp_path / "out").mkdir()
    write(asset, Painting({"base_color": new_images(asset)}), tmp_path / "out" / "new.obj")
    assert (tmp_path / "out" / "new_0.png").read_bytes() == b"an old map"
    assert read_asset(tmp_path / "out" / "new.obj").textures[0].name == "new_0_new.png"


def make_pipe(path: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("this system has no pipes among its files")
    os.mkfifo(path)


@pytest.mark.parametrize(
    "name, make",
    [
        ("../secret.png", None),
        ("/etc/hostname", None),
        ("{folder}/../secret.png", None),
        ("textures/../../secret.png", None),
        ("..\\secret.png", None),
        ("http://127.0.0.1:9/a.png", None),
        ("file:///etc/hostname", None),
        ("folder.png", lambda path: path.mkdir()),
        ("pipe.png", make_pipe),
        ("link.png", lambda path: path.symlink_to("../secret.png")),
        ("loop.png", lambda path: path.symlink_to("loop.png")),
        ("conftest.py", lambda path: path.write_text("planted")),
        (".bashrc", lambda path: path.write_text("planted")),
        ("gone.png", None),
        ("a\0.png", None),
        ("a" * 5000 + ".png", None),
    ],
)
@pytest.mark.parametrize("key", ["map_Bump", "norm", "refl -type sphere"])
def test_what_is_no_image_of_the_folder_is_told_kept_in_its_line_and_never_copied(tmp_path, name, make, key):
    (tmp_path / "secret.png").write_bytes(b"secret")
    name = name.format(folder=tmp_path / "in")
    path = saved(tmp_path / "in", mtl=f"newmtl wood\nmap_Kd textures/wood grain.png\n{key} {name}\n")
    if make:
        make(path.parent / name)
    asset = read_asset(path)
    assert asset.report.missing_images == (name,)
    out = tmp_path / "out" / "deep"
    out.mkdir(parents=True)
    write(asset, Painting({"base_color": new_images(asset)}), out / "new.obj")
    assert files(tmp_path / "out") == {"deep/new.obj", "deep/new.mtl", "deep/new_0.png"}
    assert f"{key} {name}\n".encode() in (out / "new.mtl").read_bytes()


def test_an_absolute_path_into_the_folder_becomes_relative_for_the_file_goes_along(tmp_path):
    for form in ("{}/textures/{}", "textures/../../in/textures/{1}"):
        folder = tmp_path / str(len(form)) / "in"
        names = [form.format(folder, name) for name in ("wood grain.png", "bump.png")]
        path = saved(folder, mtl="newmtl wood\nmap_Kd {}\nmap_Bump {}\n".format(*names))
        asset = read_asset(path)
        (folder.parent / "out").mkdir()
        write_copy(asset.container, folder.parent / "out" / "cube.obj")
        written = "newmtl wood\nmap_Kd textures/wood grain.png\nmap_Bump textures/bump.png\n"
        assert (folder.parent / "out" / "cube.mtl").read_text() == written
        assert read_asset(folder.parent / "out" / "cube.obj").digest == asset.digest


def test_a_given_texture_is_advised_only_where_it_takes_the_place_of_the_one_image(tmp_path):
    mtl = "newmtl wood\nmap_Kd D:\\a b\\no.png\nnewmtl bone white\nmap_Kd {}\n"
    path = saved(tmp_path, mtl=mtl.format("textures/wood grain.png"))
    with pytest.raises(ValueError, match=r"'D:\\a b\\no\.png' does not exist; put it next to the mesh$"):
        read_asset(path)
    (tmp_path / "my cube.mtl").write_text(mtl.format("D:\\a b\\no.png"))
    with pytest.raises(ValueError, match=r"put it next to the mesh, or pass --texture$"):
        read_asset(path)
    assert read_asset(path, tmp_path / "textures" / "wood grain.png").mesh.textures


# --- materials that are not there


def test_a_given_texture_is_written_for_materials_without_one(tmp_path):
    """No MTL; one that is missing; one without these materials or without their map_Kd; faces of none."""
    Image.new("RGB", (4, 4), (1, 2, 3)).save(tmp_path / "t.png")
    bare = CUBE.replace("mtllib my cube.mtl\n", "", 1).replace("usemtl wood\n", "", 1)
    added = "newmtl {}\nKd 1 1 1\nmap_Kd new.png\n".format
    none, given = "newmtl wood\r\nKd 0 1 1\r\nnewmtl bone white\r\n", "map_Kd new.png\r\n"
    cases = {  # the OBJ, its MTL; how many lines the text has more, the MTL that comes of it
        "no mtl": (bare, "", 2, added("bone white") + added("wood") + added("cube")),
        "missing": (CUBE.replace("my cube", "gone"), "", 0, added("wood") + added("bone white")),
        "nameless": (
            CUBE.replace("usemtl wood", "usemtl"),
            "newmtl cube",
            0,
            "newmtl cube\n" + added("cube_") + added("bone white"),
        ),
        "no map": (CUBE, none, 0, f"newmtl wood\r\n{given}Kd 0 1 1\r\nnewmtl bone white\r\n{given}"),
    }
    for case, (obj, mtl, more, wanted) in cases.items():
        path = saved(tmp_path / case, obj)
        (path.parent / "my cube.mtl").write_bytes(mtl.encode())
        asset = read_asset(path, tmp_path / "t.png")
        out = tmp_path / case / "out"
        out.mkdir()
        write(asset, Painting({"base_color": asset.mesh.textures}), out / "new.obj")
        assert (out / "new.mtl").read_bytes().decode() == wanted, case
        text, again = (out / "new.obj").read_text(), read_asset(out / "new.obj")
        assert len(text.splitlines()) == len(obj.splitlines()) + more, case
        assert text.count("mtllib new.mtl\n") == 1
        assert len(again.mesh.textures) == 1 and (again.mesh.textures[0] == [1, 2, 3]).all()
        assert again.report.faces_read == asset.report.faces_read and again.report.polygons == 5


# --- options of map_Kd


# --- vertex colours


@pytest.mark.parametrize("scale, more", [(1, ""), (255, ""), (1, " 0.5 # alpha"), (255, "#")])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_only_the_colours_of_vertices_change(tmp_path, scale, more, end):
    text = colored(scale, more)
    mtl = MTL.replace("map_Kd -clamp on -s 1 1 1 textures/wood grain.png\n", "")
    asset = read_asset(saved(tmp_path / "in", text, mtl, end))
    assert not asset.textures and prepared_for(asset, "obj") is asset
    (tmp_path / "out").mkdir()
    path = tmp_path / "out" / "new.obj"
    new = np.random.default_rng(0).integers(0, 256, (9, 3)).astype(np.float32) / 255
    source = asset.container
    assert isinstance(source, ObjSource)
    write(asset, Painting({}, new[source.rows]), path)
    before, after = (p.read_bytes().decode() for p in (asset.path, path))
    rows = [k for k, line in enumerate(before.split("\n")) if line.startswith(("v ", " 0  "))]
    for k, (was, now) in enumerate(zip(before.split("\n"), after.split("\n"), strict=True)):
        if k not in rows or k == rows[-1]:  # no face uses the last
            assert was == now or (was.startswith("mtllib") and now == "mtllib new.mtl" + end[:-1])
        else:
            assert was != now and now.endswith(more + end[:-1]) and now.split(" ")[:3] == was.split(" ")[:3]
    again = read_asset(path)
    assert same_bits(asset, again)
    np.testing.assert_allclose(again.mesh.corner_colors, new[source.rows][asset.corner_vertices], atol=1e-7)
    assert (tmp_path / "out" / "new.mtl").read_bytes() == (tmp_path / "in" / "my cube.mtl").read_bytes()
    assert "textures/bump.png" in files(path.parent)
    own = np.zeros((len(source.rows), 3), np.float32)
    own[asset.corner_vertices] = asset.mesh.corner_colors
    write(asset, Painting({}, own), path)
    if scale == 1:
        assert read_asset(path).digest == asset.digest
    np.testing.assert_allclose(read_asset(path).mesh.corner_colors, asset.mesh.corner_colors, atol=1e-7)


def test_black_is_read_back_as_black_from_a_file_that_counted_to_255(tmp_path):
    text = colored(255).replace("v 9 9 9", "vt 9 9 #")
    asset = read_asset(saved(tmp_path / "in", text, "newmtl wood\n"))
    dark = np.full((asset.report.vertices_read, 3), 1 / 255, np.float32)
    write(asset, Painting({}, dark), tmp_path / "in" / "new.obj")
    np.testing.assert_array_equal(read_asset(tmp_path / "in" / "new.obj").mesh.corner_colors, dark[0, 0])


def test_faces_that_repair_drops_do_not_darken_what_lies_under_them(tmp_path):
    """The same face once more, in another material: its vertices have no new colour of their own."""
    text = colored(1).replace("l 1 2", "usemtl other\nf 1/2 4/2 3/2 2/2")
    asset = read_asset(saved(tmp_path / "in", text, "newmtl wood\n"))
    assert asset.report.duplicate_faces == 2
    new = np.zeros((asset.report.vertices_read, 3), np.float32)
    new[asset.corner_vertices] = 0.75
    write(asset, Painting({}, new), tmp_path / "in" / "new.obj")
    assert (read_asset(tmp_path / "in" / "new.obj").mesh.corner_colors == 0.75).all()


# --- other formats


def test_a_byte_order_mark_is_no_part_of_the_first_word(tmp_path):
    asset = read_asset(saved(tmp_path / "in", "\ufeff" + CUBE.split("\n", 1)[1]))
    assert asset.textures[0].name == "textures/wood grain.png"
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "in" / "new.obj")
    assert (tmp_path / "in" / "new.obj").read_bytes().startswith(b"\xef\xbb\xbfmtllib new.mtl\n")
    assert read_asset(tmp_path / "in" / "new.obj").digest == asset.digest


# --- real data


@pytest.mark.parametrize("name", ["keenan_spot", "gso_Chefmate_8_Frypan", "polyhaven_boulder_01"])
def test_a_real_obj_comes_out_as_it_went_in(tmp_path, name):
    """The boulder has no MTL and no usemtl: it gets both, in two lines."""
    if "FLX_DATA" not in os.environ:
        pytest.skip("FLX_DATA is not set: it names a folder with meshes/*/info.json")
    path = next((Path(os.environ["FLX_DATA"]) / "meshes" / name).glob("*.obj"))
    Image.effect_noise((8, 8), 99).convert("RGB").save(tmp_path / "small.png")
    asset = read_asset(path, tmp_path / "small.png")
    (tmp_path / "out").mkdir()
    new = tmp_path / "out" / "new.obj"
    write(asset, Painting({"base_color": asset.mesh.textures}), new)
    own = [line for line in path.read_bytes().splitlines(True) if not line.startswith(b"mtllib")]
    lines = new.read_bytes().splitlines(True)
    assert (
        lines.pop(lines.index(b"mtllib new.mtl" + lines[-1][-2:].lstrip(b"0123456789/ "))) and len(own) > 9000
    )
    if name == "polyhaven_boulder_01":
        assert lines.pop(next(k for k, line in enumerate(lines) if line[:2] == b"f ") - 1) == b"usemtl mesh\n"
    assert lines == own and len(own) > 9000
    assert read_asset(new).digest == asset.digest
    assert files(new.parent) == {"new.obj", "new.mtl", "new.png"}
