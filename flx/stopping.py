"""Ctrl-C, SIGTERM and SIGHUP: a command ends within seconds, in one line that says what is kept.

Python hands a signal to its main thread only between two steps of Python code, and a compilation by XLA is
one step of a minute. So a thread of its own receives the signals, writes the line and ends the process.
Nothing is unwound, and nothing is lost: every file is whole or not there, even after a kill. Worker processes
end with their parent (`flx/pipeline/workers.py`).
"""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from tqdm import tqdm

from flx.files import clear_leftovers

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
PATIENCE = 3.0  # seconds until a training step that goes on after a signal is explained


def _nothing() -> str:
    return "nothing new is kept; the same command starts again"


_kept = _nothing
_watching = False  # whether the thread receives the signals of this process
_noting: "Noted | None" = None


def keeping(what: Callable[[], str]) -> None:
    """From here on, `what()` is what an interruption would keep, and how to go on."""
    global _kept
    _kept = what


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """While open, a signal ends the process with one line and the status 128 + its number.

    A signal that is ignored (by nohup, or in the background of a script) stays ignored. Other threads than
    the main one cannot take signals: there it does nothing.
    """
    global _watching
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    keeping(_nothing)
    tqdm.set_lock(
        threading.RLock()
    )  # its own is also one of processes, which Python 3.14 misses at such an end
    receiver, sender = socket.socketpair()
    sender.setblocking(False)  # the system writes to it, in whatever it interrupts
    before = signal.set_wakeup_fd(sender.fileno())
    usual = {number: signal.signal(number, lambda *_: None) for number in _not_ignored()}
    threading.Thread(target=_receive, args=(receiver,), name="signals", daemon=True).start()
    _watching = True
    try:
        yield
    finally:
        _watching = False
        for number, handler in usual.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(before)
        sender.close()  # which ends the thread


class Noted:
    """While open, the first signal is only noted, in `signal`; the second one acts as usual."""

    def __enter__(self) -> "Noted":
        global _noting
        self.signal: int | None = None
        self._usual = {}
        if _watching:
            _noting = self
        elif threading.current_thread() is threading.main_thread():  # of a notebook, say
            self._usual = {number: signal.signal(number, self._note) for number in _not_ignored()}
        return self

    def __exit__(self, *_: Any) -> None:
        global _noting
        _noting = None
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: Any) -> None:
        self.signal = number
        self.__exit__()


def _not_ignored() -> list[int]:
    return [number for number in SIGNALS if signal.getsignal(number) not in (signal.SIG_IGN, None)]


def _receive(receiver: socket.socket) -> None:
    """The thread: a byte for every signal that has a handler in Python."""
    global _noting
    with receiver:
        while True:
            try:
                received = receiver.recv(1)
            except TimeoutError:
                receiver.settimeout(None)
                _say("stopping after this step, to save it; a second signal stops at once")
                continue
            if not received:
                return
            if received[0] in SIGNALS and _noting is not None:
                _noting.signal, _noting = received[0], None
                receiver.settimeout(PATIENCE)
            elif received[0] in SIGNALS:
                end_at_once(f"stopped by {signal.Signals(received[0]).name}", 128 + received[0])


def end_at_once(why: str, status: int) -> None:
    """End the process, from any thread, with a line that says why, what is kept, and how to go on."""
    try:
        kept = _kept()
    except Exception:  # whatever it counts may be changing
        kept = "what was written whole is kept; the same command starts again"
    _say(f"{why}; {kept}", lambda: _leave(status))
    _leave(status)


def _leave(status: int) -> None:
    try:
        clear_leftovers()
    finally:
        os._exit(status)


def _say(message: str, then: Callable[[], None] = lambda: None) -> None:
    """A line instead of the progress bars; they come back after `then`."""
    with (
        contextlib.suppress(OSError, ValueError),
        tqdm.external_write_mode(sys.stderr),
    ):  # a terminal may be gone
        print(f"flx: {message}", file=sys.stderr, flush=True)
        then()
