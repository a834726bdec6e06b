"""Laws of the searches among rows of arrays."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.geometry.arrays import distinct_rows


@settings(max_examples=60)
@given(
    st.integers(1, 40), st.integers(1, 4), st.sampled_from([1, 1 << 20, 1 << 61, -1.0]), st.integers(0, 1000)
)
def test_distinct_rows_are_those_of_numpy(count, width, scale, seed):
    """Of whole numbers that fit into 63 bits with their place, without it or not; of others, with −0.0."""
    rows = np.random.default_rng(seed).integers(-1, 2, (count, width)) * scale
    first, which = distinct_rows(rows)
    expected = np.unique(rows + 0, axis=0, return_index=True, return_inverse=True)
    for ours, theirs in zip((rows[first], first, which), expected, strict=True):
        np.testing.assert_array_equal(ours, theirs.reshape(ours.shape))
