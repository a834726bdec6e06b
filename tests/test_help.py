"""Laws of `flx train --help`: what a beginner sets comes first, and fields are explained in sentences."""

import pytest

from flx.launch import main


def test_what_a_beginner_sets_comes_before_the_network(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    said = capsys.readouterr().out
    options = ("--name", "--surface.path", "--train.steps", "--model.network")
    places = [said.rindex(option) for option in options]  # the last place: examples name options too
    assert places == sorted(places)
    for words in ("Steps of the training", "Vertices of each copy", "not those of the training"):
        assert words in " ".join(said.split()).replace(" │ │ ", " ")
