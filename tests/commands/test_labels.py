"""`flx labels`: what it proposes is read back as it is; it refuses in one line, and replaces nothing."""

import re

import numpy as np
import pytest
from helpers.surfaces import icosphere
from PIL import Image

from flx.assets.arrays import from_arrays
from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.assets.write import write
from flx.geometry.atlas import atlas_texels
from flx.geometry.regions import PALETTE
from flx.launch import main
from flx.pipeline.labels import read_labels

BALL = icosphere(2)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """Seen from above and from below on one texture: the left half is red, and the upper right blue."""
    folder, corners = tmp_path_factory.mktemp("ball"), BALL.vertices[BALL.faces]
    below = corners.mean(1)[:, 2] < 0
    uvs = corners[..., :2] * [0.2, 0.4] + [0.25, 0.5] + below[:, None, None] * [0.5, 0.0]
    image = np.full((64, 128, 3), (200, 30, 30), np.uint8)
    image[:, 64:] = (30, 30, 30)
    image[:32, 64:] = (30, 60, 220)
    write(asset := from_arrays(*BALL, uvs, image), own_painting(asset), folder / "ball.glb")
    write(
        asset := from_arrays(*BALL, colors=0.5 + BALL.vertices / 2), own_painting(asset), folder / "bare.ply"
    )
    return folder


@pytest.mark.slow
def test_what_is_proposed_is_read_back(ball, tmp_path, capsys):
    out = tmp_path / "new" / "labels.png"
    words = ["labels", str(ball / "ball.glb"), "--colors", "3", "--out", str(out), "--vertices", "500"]
    assert main(words) == 0
    said = capsys.readouterr()
    assert said.out.strip() == str(out) and re.search(r"3 labels, by area #e69f00 (49|50|51)", said.err)
    asset, image = read_asset(ball / "ball.glb"), np.asarray(Image.open(out))
    labels, shown = read_labels(out, asset), atlas_texels(asset.mesh, 0, 64, 128).covered
    assert sorted(map(tuple, labels.palette)) == sorted(map(tuple, PALETTE[:3]))
    same = (labels.palette[labels.numbers] == image).all(2)
    assert shown.sum() > 3000 and same[shown].mean() > 0.98  # but for rims thinner than three texels
    assert (image[20:44, 10:54] == PALETTE[0]).all()  # all of the upper half has one colour
    assert (image[20:28, 90:102] != image[36:44, 90:102]).any(2).all()
    assert main(words) == 2 and "is there already; name another file" in capsys.readouterr().err
    assert (np.asarray(Image.open(out)) == image).all()


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["ball.glb", "--colors", "1"], "--colors is 1; give 2 to 8"),
        (["ball.glb", "--out", "labels.jpg"], "labels.jpg; name a .png"),
        (["bare.ply"], "bare.ply has 0 textures and 0 materials of one colour"),
        (["none.glb"], "none.glb does not exist"),
    ],
)
def test_what_cannot_be_proposed_is_refused_and_nothing_is_written(ball, monkeypatch, capsys, words, match):
    monkeypatch.chdir(ball)
    before = sorted(ball.iterdir())
    assert main(["labels", *words]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and match in said[0] and sorted(ball.iterdir()) == before
