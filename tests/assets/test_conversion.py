"""Laws of what a conversion says it drops."""

import pytest
from helpers.cube import MTL, saved

from flx.assets.asset import Painting
from flx.assets.preflight import check_output, left_behind
from flx.assets.read import read_asset
from flx.assets.write import write


def test_what_stays_behind_in_another_format_is_said_in_one_line(tmp_path, capsys):
    asset = read_asset(saved(tmp_path / "in", mtl=MTL + "Pm 1\nd 0.5\n"))
    told = "5 polygons, textures\\bump.png, textures/normal.tga, textures/wood grain.png, gone.png, "
    told += "textures/unused.jpg, Kd, Ns, illum, Pm, wood: -clamp on, 2 groups, "
    told += "1 smoothing group, lines and points"
    check_output(asset, "glb", [tmp_path / "out.glb"])
    said = capsys.readouterr().err
    assert said == f"{asset.path}: {told} stay behind; --format obj keeps all\n"
    check_output(asset, "obj", [tmp_path / "out.obj"])
    assert capsys.readouterr().err == f"{asset.path}: missing, but named in the new file: gone.png\n"
    assert left_behind(asset, "obj") == ""
    write(asset, Painting({"base_color": asset.mesh.textures}), tmp_path / "out.glb")
    check_output(read_asset(tmp_path / "out.glb"), "obj", [tmp_path / "out.obj"])
    assert capsys.readouterr().err == ""  # a file of flx's own: nothing is lost twice
    with pytest.raises(ValueError, match="PLY"):
        check_output(asset, "ply", [tmp_path / "out.ply"])


def test_a_map_that_became_the_alpha_of_the_image_has_not_stayed_behind(tmp_path):
    mtl = "newmtl wood\nmap_Kd textures/wood grain.png\nmap_d textures/wood grain.png\n"
    asset = read_asset(saved(tmp_path, mtl=mtl))
    assert left_behind(asset, "glb") == "5 polygons, 2 groups, 1 smoothing group, lines and points"


def test_of_a_thousand_maps_a_dozen_are_named(tmp_path):
    asset = read_asset(saved(tmp_path, mtl=MTL + "".join(f"map_Ks {k}.png\n" for k in range(1000))))
    said = left_behind(asset, "glb")
    assert ", 993 more, Kd" in said and len(said) < 400
