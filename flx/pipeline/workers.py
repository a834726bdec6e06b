"""Work shared out among processes that end with their parent, and whose death is one line.

The processes are spawned: forking a process that has started JAX can deadlock. What they need is sent when
they run, through a pipe whose other end is theirs alone: a worker that dies, even while it starts, is seen at
once. (`ProcessPoolExecutor` waits for ever where it dies while it starts, and leaves its workers behind.)
"""

import contextlib
import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any

from flx.machine import memory, processors
from flx.stopping import SIGNALS

MOST_WORKERS = 8  # a worker holds the mesh and its textures
SHARE = 0.8  # of the free memory, for workers


def in_processes(
    function: Callable[..., Any], shared: tuple, tasks: Sequence[tuple], workers: int
) -> Iterator[tuple[int, Any]]:
    """Yield (n, function(*shared, *tasks[n])) in the order in which they are ready.

    `function` must be the global of a module that loads no JAX. Raises what the function raises, and
    ChildProcessError where a worker dies; the others are then ended.
    """
    waiting, crew = deque(enumerate(tasks)), {}
    try:
        with _signals_held_back():
            for _ in range(min(workers, len(tasks))):
                connection, process = _start()
                crew[connection] = process
        for connection, process in crew.items():
            with _death_told(process):
                connection.send((function, shared))
                connection.send(waiting.popleft())
        busy = list(crew)
        while busy:
            ready: list[Any] = wait(busy)
            for connection in ready:
                with _death_told(crew[connection]):
                    number, result, error = connection.recv()
                    if waiting:
                        connection.send(waiting.popleft())
                    else:
                        busy.remove(connection)
                if error is not None:
                    raise error
                yield number, result
    finally:
        for connection, process in crew.items():
            process.kill()
            process.join()
            connection.close()


def in_order(results: Iterator[tuple[int, Any]]) -> Iterator[Any]:
    """What `in_processes` yields, in the order of the tasks."""
    early, wanted = {}, 0
    with contextlib.closing(results):  # pyright: ignore[reportArgumentType]
        for number, result in results:
            early[number] = result
            while wanted in early:
                yield early.pop(wanted)
                wanted += 1


def workers_for(bytes_each: float) -> int:
    """As many as there are processors for, and free memory."""
    fit = int(SHARE * free.free / bytes_each) if (free := memory()) else MOST_WORKERS
    return max(1, min(MOST_WORKERS, processors(), fit))


def _start() -> tuple[Connection, Any]:
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), name="flx worker", daemon=True)
    process.start()
    theirs.close()  # else the pipe would stay open after the death of the worker
    return ours, process


def _work(connection: Connection) -> None:
    """The worker: answer every task, until the parent closes the pipe or dies."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with contextlib.suppress(EOFError, OSError):
        function, shared = connection.recv()
        while True:
            number, task = connection.recv()
            try:
                answer = (number, function(*shared, *task), None)
            except Exception as error:
                error.add_note(traceback.format_exc())  # `--verbose` shows it
                answer = (number, None, error)
            connection.send(answer)


def _end_with_parent() -> None:
    if parent := parent_process():
        parent.join()
        os._exit(1)


@contextlib.contextmanager
def _death_told(process: Any) -> Iterator[None]:
    """Raises ChildProcessError where the pipe to a worker has closed."""
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError):
        process.join(1)
        code = process.exitcode
        if code is None or code >= 0:
            raise ChildProcessError(
                f"a worker process ended with status {code}; what it said stands above"
            ) from None
        reason = ", probably because memory ran out" if -code == getattr(signal, "SIGKILL", None) else ""
        name = signal.Signals(-code).name
        raise ChildProcessError(f"a worker process was killed by {name}{reason}") from None


@contextlib.contextmanager
def _signals_held_back() -> Iterator[None]:
    """Processes that are started meanwhile never see Ctrl-C, SIGTERM or SIGHUP: their parent does.

    A signal that comes meanwhile reaches this process afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing.resource_tracker import ensure_running

    ensure_running()  # it would let them through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
