"""Laws of coordinates: far from the origin, tiny or huge, they are kept, or refused by name."""

import json
import re

import numpy as np
import pytest
from helpers.files import MTL, OBJ, png
from helpers.surfaces import icosphere

from flx.assets.arrays import from_arrays
from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.write import write


@pytest.mark.parametrize("place", [(512345.0, 4512345.0, 321.0), (0.0, 0.0, 3.0)])
def test_a_mesh_far_from_the_origin_keeps_its_vertices_in_a_glb(tmp_path, place):
    """Near it, the file has no translation, and positions are the rounded ones."""
    points, faces = icosphere(4)
    asset = from_arrays(points + place, faces, colors=np.full((len(points), 3), 0.5))
    write(asset, own_painting(asset), tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    node = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])["nodes"][0]
    back = read_asset(tmp_path / "a.glb")
    assert len(back.mesh.vertices) == len(points) and len(back.mesh.faces) == len(faces)
    assert ("translation" in node) == (place[0] > 0)
    if place[0]:
        np.testing.assert_allclose(back.mesh.vertices, points + place, rtol=0, atol=2e-7)
    else:
        np.testing.assert_array_equal(back.mesh.vertices, (points + place).astype(np.float32))


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: re.sub("^v (.*)", scaled("e-25"), t, flags=re.MULTILINE), "1e-25 across; scale"),
        (lambda t: re.sub("^v (.*)", scaled("e-200"), t, flags=re.MULTILINE), "1e-200 across; scale"),
        (lambda t: t.replace("v 0 0 1", "v 0 0 1e29"), r"a vertex at .*1e\+29. is so far off"),
    ],
)
def test_a_mesh_too_small_or_stretched_too_far_is_refused_by_name(tmp_path, change, match):
    (tmp_path / "a.png").write_bytes(png())
    (tmp_path / "m.mtl").write_text(MTL)
    (tmp_path / "a.obj").write_text(change(OBJ))
    with pytest.raises(ValueError, match=match):
        read_asset(tmp_path / "a.obj")


def scaled(power: str):
    return lambda row: "v " + " ".join(number + power for number in row[1].split())


def test_names_in_code_page_1252_are_found_and_written_as_they_are(tmp_path):
    """Also where others are UTF-8."""
    mtl, text = MTL.replace("skin", "hüt").replace("a.png", "bäld €.png"), OBJ.replace("skin", "hüt")
    (tmp_path / "bäld €.png").write_bytes(png())
    (tmp_path / "m.mtl").write_bytes(mtl.encode("cp1252"))
    (tmp_path / "a.obj").write_bytes("# Prüfung\n".encode() + text.encode("cp1252"))
    asset = read_asset(tmp_path / "a.obj")
    assert asset.paints[0].name == "hüt" and asset.textures[0].name == "bäld €.png"
    (tmp_path / "out").mkdir()
    write(asset, own_painting(asset), tmp_path / "out" / "b.obj")
    assert "newmtl hüt".encode("cp1252") in (tmp_path / "out" / "b.mtl").read_bytes()
    assert read_asset(tmp_path / "out" / "b.obj").digest == asset.digest
