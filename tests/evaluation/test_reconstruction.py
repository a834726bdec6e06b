"""Laws of the table: a row for each mesh, method and vertex count; nothing is measured twice."""

import json

import numpy as np
import pytest

from flx.assets.arrays import sheet_asset
from flx.assets.asset import own_painting
from flx.assets.vase import vase_asset
from flx.assets.write import write
from flx.config import Comparison
from flx.evaluation import reconstruction
from flx.evaluation.reconstruction import markdown, means, reconstruction_table

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("table")
    write(vase := vase_asset(), own_painting(vase), folder / "vase.glb")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reconstruction, "installed_judges", lambda: ())
        measure(folder, [400], ["vertex_colours"])
        yield folder


def measure(folder, vertices, methods, images=None):
    meshes = (str(folder / "vase.glb"),)
    return reconstruction_table(
        Comparison(meshes, folder / "out", tuple(vertices), tuple(methods), images, texture_size=128)
    )


def refuse(subject):
    raise AssertionError("measured again")


def test_rows_that_are_there_are_kept_and_others_added(folder, monkeypatch):
    first = json.loads((folder / "out" / "table.json").read_text())["rows"]
    monkeypatch.setattr(reconstruction.baselines, "vertex_colours", refuse)
    assert measure(folder, [400], ["vertex_colours"]) == first
    rows = measure(folder, [400], ["vertex_colours", "flvae"])
    assert rows[0] == first[0] and [row["method"] for row in rows] == ["vertex_colours", "flvae"]
    for row in rows:
        assert 8 < row["psnr"] < 40 and 0 < row["dssim"] < 0.5 and row["seconds"] > 0
        assert row["vertices"] == 400 and row["mesh"].endswith("vase.glb")
    assert (folder / "out" / "table.md").read_text() == markdown(rows)
    measure(folder, [400], ["flvae"])
    assert json.loads((folder / "out" / "table.json").read_text())["rows"] == [rows[1], rows[0]]
    with pytest.raises(AssertionError, match="again"):  # another triangulation is another row
        measure(folder, [300], ["vertex_colours"])


def test_without_images_what_is_fitted_to_them_is_left_out_in_one_line(folder, capsys):
    rows = measure(folder, [400], ["vertex_colours", "pca"])
    assert [row["method"] for row in rows] == ["vertex_colours"]
    said = [line for line in capsys.readouterr().err.splitlines() if "--images" in line]
    assert len(said) == 1


def test_means_are_over_meshes_for_each_method_and_count():
    rows = [
        {"mesh": mesh, "method": method, "vertices": 5, "psnr": value, "seconds": 1.0, "key": "k"}
        for mesh, method, value in [("a", "x", 20.0), ("b", "x", 30.0), ("a", "y", 7.0)]
    ]
    x, y = means(rows)
    assert (x["method"], x["psnr"], x["mesh"]) == ("x", 25.0, "mean of 2") and y["psnr"] == 7.0
    lines = markdown(rows).splitlines()
    assert len(lines) == 2 + 3 + 2 and "25.00" in lines[-2] and "key" not in lines[0]


@pytest.mark.parametrize(
    ("methods", "content", "named"), [(["magic"], None, "magic"), (["flvae"], "[1]", "table.json")]
)
def test_wrong_input_is_refused_and_nothing_lost(folder, tmp_path, methods, content, named):
    if content:
        (tmp_path / "table.json").write_text(content)
    options = Comparison((str(folder / "vase.glb"),), tmp_path, (400,), texture_size=128)
    object.__setattr__(options, "methods", tuple(methods))  # the type checks of the tests stop other words
    with pytest.raises(ValueError, match=named):
        reconstruction_table(options)
    assert not content or (tmp_path / "table.json").read_text() == content


def test_an_image_is_laid_on_a_sheet_of_its_proportions(tmp_path):
    """Nothing of it is hidden or turned: as a sheet's texture, upright, it is the image itself."""
    from PIL import Image

    picture = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "picture.png")
    asset = sheet_asset(tmp_path / "picture.png")
    np.testing.assert_array_equal(asset.mesh.textures[0], picture)
    size = np.ptp(asset.mesh.vertices, axis=0)
    np.testing.assert_allclose(size / size[1], [1.5, 1, 0])
    u, v = asset.mesh.corner_uvs.reshape(-1, 2).T  # they run right and down
    x, y, _ = (asset.mesh.vertices[asset.mesh.faces] / size[1]).reshape(-1, 3).T
    np.testing.assert_allclose([u, v], [x / 1.5, 1 - y], atol=1e-6)
    meshes = (str(tmp_path / "picture.png"),)
    rows = reconstruction_table(
        Comparison(meshes, tmp_path / "out", (300,), ("vertex_colours",), atlases=True)
    )
    assert rows[0]["psnr"] > 8
    (atlas,) = (tmp_path / "out").glob("picture-300-vertex_colours-*.png")
    assert Image.open(atlas).size == (60, 40)
