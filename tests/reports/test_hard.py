"""The table of hard meshes is made as the script says, on two of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from reports.hard import HEADER, Row, cases, line


@pytest.mark.slow
def test_two_rows_of_the_table_are_measured(tmp_path):
    """A Möbius strip is cut across; crumbs stay, each a component with its boundary."""
    script, out = Path(__file__).parent / "hard.py", tmp_path / "table.md"
    names = ["Möbius strip", "crumbs smaller than a ring"]
    environment = {name: value for name, value in os.environ.items() if name != "FLX_DATA"}
    words = [sys.executable, script, "--only", *names, "--vertices", "600", "--out", out]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    head, _, *rows = [text.strip("| ").split(" | ") for text in out.read_text().splitlines()]
    assert tuple(head) == HEADER and [row[0] for row in rows] == names
    strip, crumbs = (dict(zip(HEADER, row, strict=True)) for row in rows)
    assert strip["doctor"] == "17 edges and vertices cut; mind the warning"
    assert (strip["components"], strip["loops"]) == ("1", "1")
    assert (crumbs["components"], crumbs["loops"]) == ("81", "42")
    for row in (strip, crumbs):
        assert row["vertices"] == "600" and row["exact"] == "yes"
        assert float(row["1 % angle"].strip("°")) > 35 and float(row["PSNR dB"]) > 25
        assert 50 < float(row["MB"]) < float(row["MB with JAX"])


def test_a_refusal_is_a_row_too():
    row = line("ball", Row("refused: no triangles"))
    assert row.startswith("| ball | refused: no triangles |") and row.count("|") == len(HEADER) + 1


def test_every_made_case_can_be_built(tmp_path, monkeypatch):
    monkeypatch.delenv("FLX_DATA", raising=False)
    for number, (name, case) in enumerate(cases().items()):
        (folder := tmp_path / str(number)).mkdir()
        if name != "million faces":
            assert case.build(folder).mesh.is_file()
