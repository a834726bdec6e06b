"""The notebooks run from top to bottom on public names, and their own cells assert what they show."""

import ast
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import flx
from flx import fields

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
LIBRARIES = {"flx", "jax", "matplotlib", "numpy", "optax", "PIL", "trimesh"} | sys.stdlib_module_names
OPTIONAL = "matplotlib"  # of the extra `notebook`


def code_of(path: Path) -> str:
    """The code cells."""
    cells = json.loads(path.read_text())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


def checks(code: str) -> list[ast.Assert]:
    """The asserts that look at a comparison of something computed; `assert True` is none."""
    statements = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Assert)]
    inside = [(each, list(ast.walk(each.test))) for each in statements]
    return [
        each
        for each, nodes in inside
        if any(isinstance(n, ast.Compare | ast.Call) for n in nodes)
        and any(isinstance(n, ast.Name) for n in nodes)
    ]


def strange_names(code: str) -> Iterator[str]:
    """Imports of other libraries or of flx's rooms, and names of flx that are not public."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
            yield from (n for n in names if n.split(".")[0] not in LIBRARIES or n.startswith("flx."))
        elif isinstance(node, ast.ImportFrom):
            library = str(node.module).split(".")[0]
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            yield from (
                n for n in names if library not in LIBRARIES or (library == "flx" and n != "flx.fields")
            )
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            public = {"flx": flx.__all__, "fields": fields.__all__}.get(node.value.id)
            if public is not None and node.attr not in public:
                yield f"{node.value.id}.{node.attr}"


@pytest.mark.slow
@each
def test_every_cell_runs_and_the_notebook_checks_itself(path, tmp_path):
    """Read from the input, like a notebook's: a process that it starts does not run it again."""
    code = code_of(path)
    assert checks(code), "let a cell assert what the notebook shows"
    if OPTIONAL in code and not importlib.util.find_spec(OPTIONAL):
        pytest.skip(f"{OPTIONAL} is not installed: make setup EXTRAS=dev,notebook")
    root = str(Path(flx.__file__).parent.parent)
    environment = {**os.environ, "PYTHONPATH": root, "MPLBACKEND": "agg", "PYTHONUTF8": "1"}
    command = [sys.executable, "-"]
    done = subprocess.run(
        command, input=code, cwd=tmp_path, env=environment, capture_output=True, text=True, encoding="utf-8"
    )
    assert done.returncode == 0, done.stderr
    assert list(tmp_path.iterdir()) == [], "leave nothing behind"


@each
def test_notebooks_are_stored_without_results_and_use_public_names(path):
    for cell in json.loads(path.read_text())["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None
    assert list(strange_names(code_of(path))) == []


def test_a_notebook_that_checks_nothing_or_reaches_inside_is_found():
    assert not checks("x = 1\nassert True\nx > 0") and checks("x = 1\nassert x > 0")
    inside = (
        "import flx.config\nfrom flx.types import Faces\nimport torch\nflx.assets\nfields.gather\nflx.load"
    )
    assert len(list(strange_names(inside + "\nfrom flx import viewer"))) == 6
