"""Laws of new texture coordinates: the mesh shows the same colours, and without xatlas one line says so."""

import numpy as np
import pytest
from helpers.files import colored_ball

from flx.assets.asset import Painting
from flx.assets.formats.gltf import read_gltf
from flx.assets.read import read_asset
from flx.assets.unwrap import is_unwrappable, prepared_for, unwrapped
from flx.assets.write import write
from flx.geometry.atlas import atlas_texels
from flx.geometry.sampling import surface_colors
from flx.geometry.seams import seam_ratio


def test_without_xatlas_one_line_says_how_to_install_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "xatlas", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    asset = read_asset(colored_ball(tmp_path))
    with pytest.raises(ValueError, match=r"ball\.ply has no texture coordinates; pip install '\.\[uv\]' in"):
        unwrapped(asset)
    assert prepared_for(asset, "ply") is asset and capsys.readouterr().err == ""
    assert prepared_for(asset, "glb") is asset
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "pip install '.[uv]'" in said


@pytest.mark.parametrize("through_a_run", [False, True])
def test_an_unwrapped_mesh_shows_its_vertex_colours_on_the_same_triangles(tmp_path, through_a_run):
    pytest.importorskip("xatlas", reason="xatlas is not installed: pip install '.[uv]'")
    asset = first = read_asset(colored_ball(tmp_path))
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
