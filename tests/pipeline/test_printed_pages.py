"""Law of printed pages: flat areas, hard edges."""

import numpy as np

from flx.pipeline.printed_pages import printed_pages


def test_printed_pages_have_flat_areas_hard_edges_and_both_ends_of_the_scale():
    pages = printed_pages(8, 128, 0)
    np.testing.assert_array_equal(pages[:2], printed_pages(2, 128, 0))
    steps = np.abs(np.diff(pages.astype(int), axis=2)).max(-1)
    assert (steps == 0).mean() > 0.6 and (steps > 60).mean() > 0.01
    assert printed_pages(0, 128, 0).shape == (0, 128, 128, 3)
    assert pages.min() < 30 and pages.max() > 225 and not np.array_equal(pages[0], pages[1])
