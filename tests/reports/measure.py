"""What a piece of work costs, and tables that a script of this folder makes in a process of its own."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

STATUS = Path("/proc/self/status")  # Linux only


def forget_peak() -> None:
    """From here on, `peak_megabytes` is that of what comes."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_megabytes() -> float:
    """The most memory in use; 0 where the system does not say."""
    return int(STATUS.read_text().split("VmHWM:")[1].split()[0]) / 1024 if STATUS.exists() else 0.0


def table_of(script: str, row: Any, timeout: float) -> dict[str, Any]:
    """The rows that a script of this folder prints with --json, by their names."""
    command = [sys.executable, Path(__file__).parent / script, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout)
    assert done.returncode == 0, done.stderr
    return {name: row(**values) for name, values in json.loads(done.stdout).items()}
