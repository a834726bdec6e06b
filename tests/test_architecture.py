"""The walls between the stages of the data."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module", ["flx.types", "flx.config", "flx.mesh.copies", "flx.mesh.assets", "flx.mesh.vase", "flx.launch"]
)
def test_geometry_and_the_command_line_load_no_jax(module):
    """Copies are built in processes that import this much; `--help` is quick."""
    code = f"import sys, {module}; print([m for m in ('jax', 'flax') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
