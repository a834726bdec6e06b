"""Files that are written completely or not at all."""

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

_leftovers: set[Path] = set()  # what this process would leave behind if it ended now


def write_atomically(path: Path, content: bytes | Callable[[Path], Any]) -> None:
    """Write a file completely or not at all, even if the process is killed or the power fails.

    `content` is the bytes, or a function that writes to the path it receives, which has the same suffix.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    torn = path.with_name(f".{os.getpid()}.{path.name}")
    _leftovers.add(torn)
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
        _leftovers.discard(torn)


def temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder that is deleted with the returned object, or by `clear_leftovers`."""
    folder = tempfile.TemporaryDirectory(prefix="flx-")
    _leftovers.add(Path(folder.name))
    return folder


def clear_leftovers() -> None:
    """Delete torn files and temporary folders, for a process that is about to end without unwinding."""
    for path in list(_leftovers):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
