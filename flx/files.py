"""Files that are written completely or not at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(path: Path, content: bytes | Callable[[Path], Any]) -> None:
    """Write a file completely or not at all, even if the process is killed or the power fails.

    `content` is the bytes, or a function that writes to the path it receives, which has the same suffix.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    torn = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        if isinstance(content, bytes):
            torn.write_bytes(content)
        else:
            content(torn)
        with open(torn, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(torn, path)
    finally:
        torn.unlink(missing_ok=True)
