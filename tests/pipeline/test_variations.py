"""Laws of variations: each is its own, and controls do what they say."""

import numpy as np
import pytest

from flx.assets.asset import own_painting
from flx.controls import Controls
from flx.pipeline.variations import generate

pytestmark = pytest.mark.slow


def test_variation_n_depends_on_the_seed_and_n_alone(generator):
    two, three = (list(generate(generator, count, seed=5, steps=3)) for count in (2, 3))
    for a, b in zip(two, three, strict=False):
        np.testing.assert_array_equal(a.colors, b.colors)
    assert np.abs(two[0].colors - two[1].colors).max() > 0.01
    other = next(generate(generator, 1, seed=6, steps=3))
    assert np.abs(two[0].colors - other.colors).max() > 0.01


def test_little_strength_stays_near_the_input(generator):
    """The network is untrained, so it is the start alone that knows the input."""

    def away(strength: float) -> float:
        controls = Controls(strength=strength) if strength < 1 else Controls(invention=1.0)
        painting = next(generate(generator, 1, steps=20, controls=controls))
        return float(np.abs(painting.colors - own_painting(generator.asset).colors).mean())

    assert away(0.05) < away(0.5) < away(1.0)


def test_a_strength_out_of_range_is_refused():
    for strength in (0.0, 1.2):
        with pytest.raises(ValueError, match=r"strength is .*more than 0 and at most 1"):
            Controls(strength=strength)
    with pytest.raises(ValueError, match=r"controls\.strength is nan; give a number"):
        Controls(strength=float("nan"))
