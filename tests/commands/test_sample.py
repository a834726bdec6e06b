"""Law of the contact sheet: where it shows fewer variations than there are, it says so."""

import pytest

from flx.commands.sample import captions


@pytest.mark.parametrize(
    ("count", "shown", "last"),
    [(3, 3, "variation 2"), (8, 8, "variation 7"), (20, 8, "variation 7 (8 of 20 shown)")],
)
def test_the_last_caption_says_that_there_are_more(count, shown, last):
    named = captions([f"variation {n}" for n in range(count)], shown)
    assert len(named) == shown and named[-1] == last and named[0] == "variation 0"
