"""Variations of another folder are shown beside new ones where they are of the same mesh."""

import json

import numpy as np
import pytest
from helpers.surfaces import icosphere, moved
from helpers.textured import noise
from PIL import Image

import flx
from flx.assets.arrays import from_arrays
from flx.assets.asset import Painting
from flx.commands.beside import beside
from flx.commands.sample import Sample, sample
from flx.controls import Patches

SHAPE = icosphere(2)
UVS = SHAPE.vertices[SHAPE.faces][..., :2] * 0.45 + 0.5


def written(folder, shape=SHAPE, count=2, **record):
    """A folder of variations."""
    asset = from_arrays(*shape, UVS, noise(32, 32))
    folder.mkdir()
    names = [f"variation_{n:02d}.glb" for n in range(count)]
    for n, name in enumerate(names):
        flx.save(asset, Painting({"base_color": (noise(32, 32, n + 1),)}), folder / name)
    (folder / "samples.json").write_text(json.dumps({"files": names, **record}))
    return asset


def test_variations_come_with_captions_that_say_what_made_them(tmp_path):
    asset = written(tmp_path / "first", method="instant")
    written(tmp_path / "second")
    found = beside(tmp_path / "first", asset)
    assert list(found) == ["instant 00", "instant 01"]
    assert list(beside(tmp_path / "second", asset)) == ["second 00", "second 01"]
    assert np.array_equal(found["instant 01"].images[0], noise(32, 32, 2))


def test_what_cannot_be_shown_beside_is_refused(tmp_path):
    asset = written(tmp_path / "other", moved(SHAPE, 1, 2.0))
    with pytest.raises(ValueError, match=r"variation_00\.glb is not asset\.glb with other colours"):
        beside(tmp_path / "other", from_arrays(*SHAPE, UVS, noise(32, 32), name="asset.glb"))
    written(tmp_path / "none", count=0)
    for name in ("none", "nowhere"):
        with pytest.raises(ValueError, match="no variations are there; name a folder"):
            beside(tmp_path / name, asset)


def test_the_picture_has_a_column_for_each(tmp_path):
    flx.save(written(tmp_path / "first"), Painting({"base_color": (noise(32, 32),)}), tmp_path / "ball.glb")
    options = {"run": tmp_path / "ball.glb", "instant": True, "count": 1, "patches": Patches(vertices=100)}
    widths = []
    for name, folder in (("alone", None), ("beside", tmp_path / "first")):
        out = sample(Sample(**options, out=tmp_path / name, beside=folder))
        widths.append(Image.open(out / "contact_sheet.png").width)
        assert ("first 01" in (out / "viewer.html").read_text()) == (folder is not None)
        assert "beside" not in json.loads((out / "samples.json").read_text()), "no file depends on it"
    assert widths[1] > 1.8 * widths[0], "four columns for two"
