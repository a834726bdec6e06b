"""Law of data: what is loaded from a run folder or a weights file never executes."""

import ast
import zipfile
from pathlib import Path

import numpy as np
import pytest

import flx
from flx.pipeline.copies import load_tables

SOURCES = sorted(Path(flx.__file__).parent.rglob("*.py"))
# Calls that run what they are given. An Unpickler of one's own, which says what it finds, is none.
CODE = {"eval", "exec", "compile", "__import__", "pickle.load", "pickle.loads", "pickle.Unpickler"}
MODULES = {"cloudpickle", "dill", "joblib", "marshal", "shelve", "torch", "yaml"}


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "executed")


def test_a_pickle_in_the_place_of_tables_is_not_executed(tmp_path):
    path, mark = tmp_path / "tables.npz", tmp_path / "mark"
    np.savez(path, **dict.fromkeys(_names(tmp_path), np.array([Trap(mark)], object)))
    with pytest.raises(ValueError, match="allow_pickle"):
        load_tables(path)
    assert not mark.exists()
    with np.load(path, allow_pickle=True) as trap:  # the trap works
        assert all(trap[name] is not None for name in trap.files)
    assert mark.exists()


def _names(folder: Path) -> list[str]:
    """What a file of tables holds."""
    from helpers.surfaces import icosphere

    from flx.geometry.tables import mesh_tables
    from flx.pipeline.copies import save_tables
    from flx.types import Triangulation

    save_tables(folder / "good.npz", mesh_tables(Triangulation(*icosphere(1))))
    return [Path(name).stem for name in zipfile.ZipFile(folder / "good.npz").namelist()]


def test_only_configs_are_code():
    """Read from the sources: no unpickler, and one place that runs a file, the config's."""
    found = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import | ast.ImportFrom):
                names = (
                    [node.module or ""] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
                )
                found += [f"{path.name}: {name}" for name in names if name.split(".")[0] in MODULES]
            if isinstance(node, ast.Call):
                name = ast.unparse(node.func)
                if name in CODE or name.endswith(".exec_module"):
                    found.append(f"{path.name}: {name}")
                refused = any(
                    k.arg == "allow_pickle" and ast.unparse(k.value) == "False" for k in node.keywords
                )
                if name in ("np.load", "numpy.load") and not refused:
                    found.append(f"{path.name}: {name}")
    assert found == ["config.py: spec.loader.exec_module"]
