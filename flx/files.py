"""Files that are written completely or not at all."""

import contextlib
import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

TORN = ".flx-"  # how the name of a file begins that is not whole yet; the number of its writer follows
_leftovers: set[Path] = set()  # what this process would leave behind if it ended now


def write_atomically(path: Path, content: bytes | Callable[[Path], Any]) -> None:
    """Write a file completely or not at all, even if the process is killed or the power fails.

    `content` is the bytes, or a function that writes to the path it receives, which has the same suffix. What
    killed writers left in the folder is cleared. Raises OSError, naming the file, where the disk is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _clear_torn(path.parent)
    refuse_folder(path)
    torn = path.with_name(f"{TORN}{os.getpid()}.{path.name[-50:]}")  # a name has at most 255 bytes
    _leftovers.add(torn)
    try:
        with naming_a_full_disk(path):
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


def refuse_folder(path: Path) -> None:
    """Raises IsADirectoryError for a folder in the place of a file, which nobody but its owner may delete."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, and a file should be there; delete it")


def check_place(path: Path, remedy: str = "name another folder with --out") -> None:
    """Raises ValueError where no file can be written at `path`, with what is in the way. Makes nothing."""
    try:
        _is_there(path)  # is it a name at all?
        place = next(folder for folder in path.absolute().parents if _is_there(folder))
    except OSError as fault:
        raise ValueError(f"{str(path)[:60]}… is no place for a file ({fault.strerror}); {remedy}") from fault
    if not place.exists():
        raise ValueError(f"{place} is a link that leads nowhere; {remedy}")
    if not place.is_dir():
        raise ValueError(f"{place} is a file; {remedy}")
    if not os.access(place, os.W_OK | os.X_OK):
        raise ValueError(f"{place} is not writable; {remedy}")


def _is_there(path: Path) -> bool:
    """Whether there is anything, if only a link."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


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


@contextlib.contextmanager
def naming_a_full_disk(path: Path) -> Iterator[None]:
    """Raise OSError with the file, and what to do, where the disk has no room for what is written inside."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        message = f"the disk is full: {path} was not written; make room, and give the same command again"
        raise OSError(error.errno, message) from error


def _clear_torn(folder: Path) -> None:
    for torn in folder.glob(f"{TORN}*.*"):
        writer = torn.name.removeprefix(TORN).partition(".")[0]
        if writer.isdecimal() and not _is_running(int(writer)):
            torn.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name != "posix":  # elsewhere signal 0 is not only a question
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
