"""Laws of `--help`: what a beginner sets comes first, or alone, and fields are explained in sentences."""

import pytest

from flx.commands.help import FIRST
from flx.launch import main


def said(capsys, *words: str) -> str:
    with pytest.raises(SystemExit) as end:
        main([*words])
    assert not end.value.code
    return capsys.readouterr().out


def test_what_a_beginner_sets_comes_before_the_network(capsys):
    told = said(capsys, "train", "--help-all")
    options = ("--name", "--surface.path", "--train.steps", "--model.network")
    places = [told.rindex(option) for option in options]  # the last place: examples name options too
    assert places == sorted(places)
    for words in ("Steps of the training", "Vertices of each copy", "not those of the training"):
        assert words in " ".join(told.split()).replace(" │ │ ", " ")


@pytest.mark.parametrize("verb", FIRST)
def test_help_names_the_first_options_alone_and_where_the_others_are(capsys, verb):
    short, every = said(capsys, verb, "--help"), said(capsys, verb, "--help-all")
    assert short == said(capsys, verb, "-h") and short.startswith("usage: ")
    lines = [[line.strip("│ ") for line in text.splitlines()] for text in (short, every)]  # frames differ
    options, known = ({line.split()[0].strip(",") for line in text if line[:2] == "--"} for text in lines)
    assert options == known & {*FIRST[verb].split()} and 10 <= len(options) < 0.6 * len(known)
    assert lines[0][-1] == f"flx {verb} --help-all lists every option."
    assert short.count("╭") == short.count("╰") > 2


def test_help_of_the_other_verbs_is_whole(capsys):
    assert said(capsys, "bench", "--help") == said(capsys, "bench", "--help-all")
