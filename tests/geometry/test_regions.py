"""Laws of proposed regions: they follow colours, largest first, and specks vanish in them."""

import numpy as np
import pytest
from helpers.surfaces import icosphere

from flx.geometry.regions import PALETTE, regions

BALL = icosphere(4)
HEIGHT = BALL.vertices[:, 2]
ZONES = np.digitize(HEIGHT, [0.0, 0.7])  # half, a bit more than a third, a seventh
COLORS = np.array([(0.8, 0.1, 0.1), (0.1, 0.7, 0.2), (0.2, 0.2, 0.8)], np.float32)[ZONES]


def found(colors: np.ndarray, count: int = 3, seed: int = 0) -> np.ndarray:
    return regions(colors.astype(np.float32), BALL.faces, count, np.random.default_rng(seed)).argmax(1)


@pytest.mark.parametrize("seed", range(3))
def test_zones_of_one_colour_each_are_found_largest_first(seed):
    away = np.minimum(np.abs(HEIGHT), np.abs(HEIGHT - 0.7)) > 0.2
    np.testing.assert_array_equal(found(COLORS, seed=seed)[away], ZONES[away])
    assert away.sum() > 1000 and set(ZONES[away]) == {0, 1, 2}


def test_specks_vanish():
    rng = np.random.default_rng(1)
    specks = np.where(rng.random((2562, 1)) < 0.1, 1 - COLORS, COLORS)
    assert (found(specks) != found(COLORS)).mean() < 0.03


def test_what_is_not_there_is_not_found():
    with pytest.raises(ValueError, match=r"make 1 regions, not 2; ask for fewer"):
        found(np.full((2562, 3), 0.5), 2)


def test_colours_of_the_palette_are_apart():
    apart = np.abs(PALETTE[:, None].astype(int) - PALETTE).max(2)
    assert (apart + 255 * np.eye(len(PALETTE)) > 60).all()
