"""The walls between the stages of the data; names that are there."""

import builtins
import dis
import importlib
import inspect
import pkgutil
import subprocess
import sys
from types import CodeType

import pytest

import flx


@pytest.mark.parametrize(
    "module",
    ["flx.types", "flx.config", "flx.geometry.copies", "flx.assets.read", "flx.assets.vase", "flx.launch"],
)
def test_geometry_and_the_command_line_load_no_jax(module):
    """Copies are built in processes that import this much; `--help` is quick."""
    code = f"import sys, {module}; print([m for m in ('jax', 'flax') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def global_names(code: CodeType) -> set[str]:
    """The global names that the functions of a piece of code use."""
    names = {step.argval for step in dis.get_instructions(code) if step.opname == "LOAD_GLOBAL"}
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return names.union(*map(global_names, inner))


@pytest.mark.parametrize("name", [m.name for m in pkgutil.walk_packages(flx.__path__, "flx.")])
def test_every_global_name_is_defined(name):
    """Linters take a shape, such as "N", for the name of a type: they cannot look for names that are not."""
    module = importlib.import_module(name)
    used = global_names(compile(inspect.getsource(module), name, "exec"))
    assert {n for n in used if not hasattr(module, n) and not hasattr(builtins, n)} == set()
