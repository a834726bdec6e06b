"""Law of the two scales of light: each is the other's inverse."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flx.geometry.color import linear, srgb


@given(hnp.arrays(np.float64, 5, elements=st.floats(0, 1)))
def test_srgb_and_linear_are_inverse(values):
    assert np.allclose(linear(srgb(values)), values, atol=1e-12)
    assert np.all(np.diff(srgb(np.sort(values))) >= 0)
