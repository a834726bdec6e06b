"""Laws of what this machine gives to a process."""

import os
import subprocess
import sys

import pytest

from flx import machine


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system binds no process to a processor")
def test_processors_are_those_that_this_process_may_use():
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(before)})
        assert machine.processors() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert machine.processors() == len(before)


def test_memory_is_what_the_tightest_container_leaves(tmp_path, monkeypatch):
    """Files that could be dropped do not count as used."""
    whole = machine.memory()
    assert whole and 1e8 < whole.free <= whole.total
    for name, limit, current in (("inner", "1000000000", 700_000_000), ("outer", "max", 9)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "memory.max").write_text(limit + "\n")
        (tmp_path / name / "memory.current").write_text(f"{current}\n")
        (tmp_path / name / "memory.stat").write_text("anon 5\ninactive_file 200000000\n")
    folders = [tmp_path / "inner", tmp_path / "outer", tmp_path / "none"]
    monkeypatch.setattr(machine, "_containers", lambda: folders)
    assert machine.memory() == machine.Memory(1e9, 5e8)


def test_a_system_that_does_not_say_has_no_limit(monkeypatch):
    monkeypatch.delattr(os, "sysconf")
    assert machine.memory() is None


@pytest.mark.skipif(not hasattr(os, "nice"), reason="POSIX alone has priorities")
def test_a_process_yields_to_others():
    code = "import os; from flx.machine import yield_to_others; yield_to_others(); print(os.nice(0))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == 19
