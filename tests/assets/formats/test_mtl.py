"""Laws of material libraries: what they say is kept, and only what is told is changed."""

import numpy as np
from helpers.cube import CUBE, MTL, changed, saved
from hypothesis import given
from hypothesis import strategies as st

from flx.assets.asset import Painting
from flx.assets.formats.mtl import files_named, parse_mtl, renamed, repainted
from flx.assets.read import read_asset
from flx.assets.write import write


def test_each_of_several_libraries_stays_a_file_of_its_own(tmp_path):
    path = saved(tmp_path / "in", CUBE.replace("my cube.mtl", "a.mtl b.MTL\nmtllib gone.mtl"))
    (path.parent / "a.mtl").write_text("newmtl wood\nmap_Kd textures/wood grain.png\n")
    (path.parent / "b.MTL").write_text("Kd 1 0 0\nnewmtl bone white\nKd 0.2 0.4 0.6\n")
    asset = read_asset(path)
    (tmp_path / "out").mkdir()
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out" / "new.obj")
    assert changed(path, tmp_path / "out" / "new.obj") == [
        (b"mtllib a.mtl b.MTL\n", b"mtllib new.mtl new_1.mtl\n")
    ]
    assert (tmp_path / "out" / "new_1.mtl").read_bytes() == (path.parent / "b.MTL").read_bytes()
    assert read_asset(tmp_path / "out" / "new.obj").digest == asset.digest


def test_scale_and_offset_of_an_image_move_the_texture_coordinates(tmp_path):
    one = MTL.replace("-clamp on -s 1 1 1", "-o 0.25 0.5 -s 0.5 2 -mm 0 1")
    moved = read_asset(saved(tmp_path / "a", mtl=one))
    plain = read_asset(saved(tmp_path / "b"))
    up = lambda asset: asset.mesh.corner_uvs[asset.mesh.face_textures == 0] * [1, -1] + [0, 1]  # noqa: E731
    np.testing.assert_allclose(up(moved), up(plain) * [0.5, 2] + [0.25, 0.5], atol=1e-15)
    flat = plain.mesh.face_textures == 1
    np.testing.assert_array_equal(moved.mesh.corner_uvs[flat], plain.mesh.corner_uvs[flat])
    assert moved.report.ignored_options == ("wood: -mm 0 1",)
    (tmp_path / "out").mkdir()
    write(moved, Painting({"base_color": moved.mesh.textures}), tmp_path / "out" / "new.obj")
    assert read_asset(tmp_path / "out" / "new.obj").digest == moved.digest  # once, not twice


words = st.text("abcXYZ019_-.#/\\ \t", max_size=12)


mtl_lines = st.one_of(
    st.sampled_from(["newmtl a", "newmtl b", "newmtl  b\t", " NEWMTL a", "Kd 0.1 0.2 0.3", "", "# newmtl a"]),
    st.builds("map_Kd {}".format, words),
    st.builds("map_Kd -s 1 2 -clamp on {}".format, words),
    st.builds("{} {}".format, st.sampled_from(["norm", "map_Ks", "bump -bm 1", "illum", "map_aat"]), words),
)


libraries = st.builds(
    lambda lines, end, last: (end.join(lines) + end * last).encode(),
    st.lists(mtl_lines, max_size=8),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.booleans(),
)


@given(libraries)
def test_a_library_says_what_it_is_told_and_else_what_it_said(content):
    """Of map_Kd alone, and of it alone where it was asked; the same names in give the same bytes out."""
    old, new = parse_mtl(content), parse_mtl(repainted(content, {"a": "my new.png"}))
    assert old.keys() == new.keys()
    for name, material in new.items():
        assert material == (old[name]._replace(image="my new.png") if name == "a" else old[name])
    names = {name: f"{name}x" for name in files_named(content)}
    away = renamed(content, names)
    assert files_named(away) == list(names.values())
    assert renamed(away, {new: old for old, new in names.items()}) == content
    assert repainted(content, {}) == renamed(content, {n: n for n in names}) == content
