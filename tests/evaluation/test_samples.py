"""The judge ranks textures that are worse by construction, and sees a copy as a copy."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from flx.assets.vase import vase_asset
from flx.assets.write import write_png
from flx.commands.evaluate import Evaluate
from flx.evaluation import samples
from flx.evaluation.controls import controls
from flx.evaluation.report import page
from flx.evaluation.samples import judge_samples

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def mesh():
    asset = vase_asset()
    return asset.mesh.with_layer(images=(asset.mesh.textures[0][::2, ::2],))


@pytest.fixture(scope="module", autouse=True)
def fewer_charts():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(samples, "BANK", (500, 400, 200))
        patch.setattr(samples, "QUERIES", (200, 150, 100))
        yield


def ragged(mesh, amount):
    """The texture with its outlines displaced at random, by `amount` texels."""
    image, rng = mesh.textures[0], np.random.default_rng(0)
    noise = np.stack([gaussian_filter(rng.normal(size=image.shape[:2]), 3) for _ in range(2)])
    places = np.indices(image.shape[:2]) + amount * noise / noise.std()
    moved = [map_coordinates(image[..., c].astype(float), places, order=1, mode="wrap") for c in range(3)]
    return mesh.with_layer(images=(np.stack(moved, -1).astype(np.uint8),))


@pytest.fixture(scope="module")
def rows(mesh):
    new = {f"ragged {n}": ragged(mesh, n) for n in (1, 3, 6)}
    return judge_samples(mesh, {"copy": mesh, "again": mesh}, new | controls(mesh, 0))


@pytest.mark.parametrize("metric", ["swd_1", "swd_5"])
def test_the_more_ragged_the_worse_and_a_blur_is_worst(rows, metric):
    order = ["input", "ragged 1", "ragged 3", "ragged 6", "blur"]
    values = [rows[name][metric] for name in order]
    assert values == sorted(values) and len(set(values)) == len(values)


def test_what_has_no_structure_or_another_one_is_worse_than_what_is_ragged(rows):
    for name in ("noise", "checks"):
        assert rows[name]["swd_5"] > 2 * rows["ragged 3"]["swd_5"]
        assert rows[name]["coverage_5"] < 0.1 < rows["ragged 3"]["coverage_5"]


def test_a_copy_is_exposed_and_shuffled_tiles_are_not_a_copy(rows):
    assert rows["samples"]["copied_1"] == rows["samples"]["copied_5"] == 1
    assert rows["samples"]["coverage_5"] == 1
    assert rows["samples"]["diversity"] == 0
    assert rows["shuffled"]["copied_1"] < 0.05


def test_large_charts_see_that_tiles_are_shuffled(rows):
    assert rows["shuffled"]["coverage_20"] < 0.9 < rows["copy"]["coverage_20"]


def test_the_same_seed_gives_the_same_numbers(mesh, rows):
    again = judge_samples(mesh, {"copy": mesh})
    assert again["input"] == rows["input"]


def test_a_sample_on_another_surface_cannot_copy_a_place(mesh, rows):
    other = mesh._replace(vertices=mesh.vertices * [1, 1.1, 1])
    judged = judge_samples(mesh, {"other": other})
    assert "copied_1" not in judged["other"] and judged["other"]["swd_5"] < 2 * rows["input"]["swd_5"]


def test_the_page_holds_every_number_and_escapes_names(rows):
    html = page("a <vase>", np.zeros((8, 8, 3), np.uint8), {"a <b>": {"swd_1": 0.125}})
    assert "a &lt;vase&gt;" in html and "a &lt;b&gt;" in html and "0.125" in html and "<b>" not in html


def test_files_are_judged_by_the_command(mesh, tmp_path, monkeypatch):
    from flx.assets.asset import Painting
    from flx.assets.write import write

    asset = vase_asset()
    for name, texture in (("input", mesh), ("ragged", ragged(mesh, 3))):
        write(asset, Painting({"base_color": texture.textures}), tmp_path / f"{name}.glb")
    out = tmp_path / "judged"
    Evaluate(source=tmp_path / "input.glb", samples=(tmp_path / "ragged.glb",), out=out)()
    rows = json.loads((out / "evaluation.json").read_text())["rows"]
    assert rows["input"]["swd_5"] < rows["ragged"]["swd_5"] < rows["blur"]["swd_5"]
    assert "<svg" in (out / "evaluation.html").read_text()


def test_a_mesh_without_samples_is_refused(tmp_path):
    write_png(tmp_path / "x.png", np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(ValueError, match="--samples"):
        Evaluate(source=tmp_path / "x.png")()


def test_samples_of_one_name_are_refused(tmp_path):
    with pytest.raises(ValueError, match="same name"):
        Evaluate(source=tmp_path, samples=(tmp_path / "a" / "x.glb", tmp_path / "b" / "x.glb"))()
