"""Files written whole or not at all."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_atomically(path: Path, content: bytes | Callable[[Path], Any]) -> None:
    """Write a file that is there whole or not at all, even through a kill or a power cut.

    `content` is the bytes, or a function that writes the file at the path it is given (of the same suffix).
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
