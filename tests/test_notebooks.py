"""The notebooks run from top to bottom, and what they show is so: their own cells assert it."""

import ast
import json
from pathlib import Path

import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


def code_of(path: Path) -> list[str]:
    """The code cells."""
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def checks(cells: list[str]) -> list[ast.Assert]:
    """The asserts that look at a comparison of something computed; `assert True` is none."""
    statements = [node for node in ast.walk(ast.parse("\n".join(cells))) if isinstance(node, ast.Assert)]
    inside = [(each, list(ast.walk(each.test))) for each in statements]
    return [
        each
        for each, nodes in inside
        if any(isinstance(n, ast.Compare) for n in nodes) and any(isinstance(n, ast.Name) for n in nodes)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_cell_runs_and_the_notebook_checks_itself(path):
    cells, names = code_of(path), {"__name__": "__main__"}
    assert checks(cells), "let a cell assert what the notebook shows"
    for number, cell in enumerate(cells):
        exec(compile(cell, f"{path.name}, code cell {number}", "exec"), names)


def test_a_notebook_that_checks_nothing_is_found():
    assert not checks(["x = 1", "assert True", "x > 0"]) and checks(["x = 1", "assert x > 0"])
