"""What a command without a progress bar is doing."""

import sys
import time


class Stages:
    """Says on stderr, after the checks are passed, which of its stages a command begins, and since when."""

    def __init__(self, count: int):
        self._count, self._done, self._began = count, 0, time.monotonic()

    def __call__(self, what: str) -> None:
        self._done += 1
        seconds = time.monotonic() - self._began
        print(f"{self._done}/{self._count} {what} ({seconds:.0f} s so far)", file=sys.stderr, flush=True)
