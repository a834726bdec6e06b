"""What `flx sample` writes beside the variations: captions of the contact sheet, and the record."""

import json

import numpy as np
import pytest
from helpers.surfaces import icosphere
from helpers.textured import noise
from PIL import Image
from scipy.ndimage import gaussian_filter

import flx
from flx.assets.arrays import from_arrays
from flx.assets.asset import own_painting
from flx.commands.sample import Sample, captions, sample
from flx.controls import Controls, Patches
from flx.geometry.seams import border_ratio


@pytest.mark.parametrize(
    ("count", "shown", "last"),
    [(3, 3, "variation 2"), (8, 8, "variation 7"), (20, 8, "variation 7 (8 of 20 shown)")],
)
def test_the_last_caption_says_that_there_are_more(count, shown, last):
    named = captions([f"variation {n}" for n in range(count)], shown)
    assert len(named) == shown and named[-1] == last and named[0] == "variation 0"


def test_the_record_compares_the_border_of_what_is_kept_with_the_inputs(tmp_path):
    shape = icosphere(2)
    uvs = shape.vertices[shape.faces][..., :2] * 0.45 + 0.5
    asset = from_arrays(*shape, uvs, gaussian_filter(noise(64, 64), (2, 2, 0)))
    flx.save(asset, own_painting(asset), tmp_path / "ball.glb")
    mask = np.zeros((64, 64), np.uint8)
    mask[:, :32] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    controls, patches = Controls(keep=tmp_path / "mask.png"), Patches(vertices=100)
    options = {"instant": True, "count": 1, "viewer": False, "controls": controls, "patches": patches}
    out = sample(Sample(run=tmp_path / "ball.glb", out=tmp_path / "made", **options))
    record = json.loads((out / "samples.json").read_text())
    assert record["border_ratio_input"] == border_ratio(asset.mesh, 0, mask > 0)
    assert len(record["border_ratios"]) == 1
