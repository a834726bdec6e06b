"""Processes that tests stop: started, listed and watched."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

TESTS = Path(__file__).parents[1]


def python(script: str, *arguments: str) -> subprocess.Popen:
    """A script in a process of its own, the leader of a group; it may import `helpers`."""
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        cwd=TESTS,  # -c: modules are looked for where it starts
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def said(child: subprocess.Popen) -> str:
    """All that it writes to stderr until it ends; a progress bar's \\r stays what it is."""
    assert child.stderr
    return child.stderr.read().decode()


def wait_until(holds: Callable[[], object], seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.02)


def runs(pid: int) -> bool:
    """Whether the process is there, and not only its exit status."""
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout
    return bool(state.strip()) and not state.startswith("Z")


def sign_in_and_sleep(folder: str) -> None:
    """A task for a worker: a file named after its process."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(600)
