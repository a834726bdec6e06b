"""Laws of worker processes: they answer all, they end with their parent, and their death is told."""

import math
import operator
import os
import signal
import time

import pytest
from helpers.processes import python, runs, said, wait_until

from flx.machine import Memory
from flx.pipeline import workers
from flx.pipeline.workers import in_order, in_processes, workers_for

WORKING = """
import sys
from helpers.processes import sign_in_and_sleep
from flx.pipeline.workers import in_processes
from flx.stopping import ended_by_signals, keeping

if __name__ == "__main__":
    with ended_by_signals():
        keeping(lambda: "2 of 9 are kept")
        list(in_processes(sign_in_and_sleep, (sys.argv[1],), [()] * 4, 2))
"""


@pytest.mark.slow
def test_every_task_is_answered_once():
    answers = list(in_processes(operator.mul, (3,), [(n,) for n in range(7)], 2))
    assert sorted(answers) == [(n, 3 * n) for n in range(7)]


@pytest.mark.slow
def test_results_are_put_in_the_order_of_their_tasks():
    ready = ((n, str(n)) for n in (2, 0, 1, 4, 3))
    assert list(in_order(ready)) == ["0", "1", "2", "3", "4"]


def test_an_error_comes_back_with_the_place_where_it_was_raised():
    with pytest.raises(ValueError, match=r"math domain error|nonnegative") as error:
        list(in_processes(math.sqrt, (), [(-1,), (4,)], 2))
    assert "workers.py" in error.value.__notes__[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "task", "told"),
    [
        (signal.raise_signal, signal.SIGKILL, "was killed by SIGKILL, probably because memory ran out"),
        (os._exit, 3, "ended with status 3"),
    ],
)
def test_a_worker_that_dies_is_told(function, task, told):
    with pytest.raises(ChildProcessError, match=told) as error:
        list(in_processes(function, (), [(task,)], 1))
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_worker_that_dies_while_it_starts_is_told_too(monkeypatch):
    """What it gets is more than a pipe holds: sending it waited for ever."""
    start = workers._start

    def killed():
        connection, process = start()
        process.kill()
        return connection, process

    monkeypatch.setattr(workers, "_start", killed)
    with pytest.raises(ChildProcessError, match="killed by SIGKILL"):
        list(in_processes(operator.add, (bytes(10**6),), [(b"",)] * 2, 2))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda n: n.name)
def test_workers_end_with_their_parent(tmp_path, number):
    """Also where nobody can tell them: the parent is killed. A terminal sends Ctrl-C to all of them."""
    child = python(WORKING, str(tmp_path))
    wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    pids = [int(path.name) for path in tmp_path.iterdir()]
    assert all(map(runs, pids))
    if number == signal.SIGINT:
        os.killpg(child.pid, number)
    else:
        os.kill(child.pid, number)
    began = time.monotonic()
    wait_until(lambda: not any(map(runs, pids)), 5)
    assert time.monotonic() - began < 5
    told = said(child)
    assert child.wait(10) == (-number if number == signal.SIGKILL else 128 + number)
    wanted = "" if number == signal.SIGKILL else f"flx: stopped by {number.name}; 2 of 9 are kept\n"
    assert told.split("\r")[-1] == wanted


@pytest.mark.slow
def test_ctrl_c_while_workers_start_is_one_line(tmp_path):
    child = python(WORKING.replace("list(", "import os; os.write(2, b'x'); list("), str(tmp_path))
    assert child.stderr and child.stderr.read(1) == b"x"
    time.sleep(0.2)
    os.killpg(child.pid, signal.SIGINT)
    assert said(child).split("\r")[-1] == "flx: stopped by SIGINT; 2 of 9 are kept\n"
    assert child.wait(10) == 130


def test_workers_fit_into_the_free_memory_and_are_no_more_than_processors(monkeypatch):
    monkeypatch.setattr(workers, "processors", lambda: 6)
    monkeypatch.setattr(workers, "memory", lambda: Memory(64e9, 10e9))
    assert [workers_for(each) for each in (1e8, 2e9, 3e9, 1e11)] == [6, 4, 2, 1]
    monkeypatch.setattr(workers, "memory", lambda: None)
    assert workers_for(1e12) == 6
