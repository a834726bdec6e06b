"""Opens files safely: only regular ones, of bounded size, in the folder of the mesh.

A mesh file is a stranger's. It must not read its user's other files, reach the network, block on a pipe or
take more memory than its own size explains. The limits are generous; each can be raised by an environment
variable, which the error names.
"""

import codecs
import os
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num

LIMITS = {
    "FLX_MAX_BYTES": 1 << 29,  # of one file
    "FLX_MAX_PIXELS": 8192 * 8192,  # of one image; four times as many in all
    "FLX_MAX_FACES": 1 << 22,  # of a mesh, its instances counted
}


class BadFile(ValueError):
    """A known fault of the file; the message says what to do about it."""


def limit(name: str) -> int:
    """The limit from the environment or `LIMITS`. Raises ValueError where it is not a whole number."""
    value = os.environ.get(name, "")
    if value and not value.isdecimal():
        raise ValueError(f"{name} is {value!r}; set it to a whole number, or unset it")
    return int(value) if value else LIMITS[name]


def inside(folder: Path, name: str) -> Path:
    """The path of a file that a file in this folder names. Links are followed.

    Raises BadFile for a URL and for a name that leads out of the folder.
    """
    if "://" in name:
        raise BadFile(f"{name[:80]!r} is a URL, and nothing is fetched; put the file next to the mesh")
    try:
        path = (folder / name.replace("\\", "/")).resolve()
    except (RuntimeError, ValueError) as fault:  # a link to itself, a NUL
        raise BadFile(f"{name[:80]!r} leads nowhere ({fault}); put the file next to the mesh") from fault
    if not path.is_relative_to(folder.resolve()):
        raise BadFile(f"{quoted(name)} lies outside {folder}; copy it there, and name it without its folder")
    return path


def quoted(name: str) -> str:
    """A name as it stands in a file, on one line; unprintable characters are escaped, backslashes are not."""
    return repr(name[:120]).replace("\\\\", "\\")


def is_absolute(name: str) -> bool:
    """Whether a name is a path from the root of some machine, this one or another."""
    return re.match(r"[A-Za-z]:|[/\\]", name) is not None


def is_there(folder: Path, name: str) -> bool:
    """Whether a file that a file in this folder names exists."""
    try:
        return inside(folder, name).is_file()
    except (BadFile, OSError):
        return False


def found_beside(folder: Path, name: str) -> str:
    """The file that a dangling name means; "" where the name is valid, and for no match or several.

    Of an absolute path from another machine only the last part must match, of a relative one all of it. Case
    is ignored, as on Windows and macOS. Only the folder and those below it are searched.
    """
    if is_there(folder, name):
        return ""
    words = re.split(r"[/\\]", name)
    matched: list[str] = []
    for word in [words[-1]] if is_absolute(name) else [w for w in words if w not in ("", ".")]:
        try:
            entries = os.listdir(inside(folder, "/".join(matched)))
        except (BadFile, OSError):
            return ""
        alike = [entry for entry in entries if entry.casefold() == word.casefold()]
        if len(alike) != 1:
            return ""
        matched += alike
    return "/".join(matched) if matched and is_there(folder, "/".join(matched)) else ""


def substitution(names: tuple[str, str]) -> str:
    """A name in a file, and the file that was read in its place."""
    return f"{quoted(names[0])} → {names[1]}"


def read_file(path: Path) -> bytes:
    """All bytes of a regular file.

    Raises FileNotFoundError, or BadFile for a folder, a pipe, a device, and more than `FLX_MAX_BYTES`.
    """
    try:
        size = path.stat().st_size
    except NotADirectoryError as fault:  # a.png/b.png
        raise FileNotFoundError(fault.errno, fault.strerror, str(path)) from fault
    if not path.is_file():
        raise BadFile(f"{path} is not a file; name one, or copy it there")
    if size > (most := limit("FLX_MAX_BYTES")):
        raise BadFile(f"{path} has {size:,} bytes, over {most:,}; reduce it, or set FLX_MAX_BYTES={size}")
    with open(path, "rb") as file:
        return file.read(size)


def check_faces(count: int) -> None:
    """Raises BadFile for more faces than `FLX_MAX_FACES`, before anything of their size is made."""
    if count > (most := limit("FLX_MAX_FACES")):
        raise BadFile(f"{count:,} faces, more than {most:,}; decimate it, or set FLX_MAX_FACES={count}")


def _as_cp1252(fault: UnicodeError) -> tuple[str, int]:
    assert isinstance(fault, UnicodeDecodeError)
    return fault.object[fault.start : fault.end].decode("cp1252", errors="replace"), fault.end


codecs.register_error("flx.cp1252", _as_cp1252)


def text_of(content: bytes) -> str:
    """The text of UTF-8, without its mark; bytes that are not UTF-8 are taken for Windows' code page 1252."""
    return content.decode("utf-8-sig", errors="flx.cp1252")


def numbers(text: str, dtype: type = np.float64) -> Num[Any, "N"]:
    """The numbers of a text, separated by white space. Raises BadFile for anything else in it."""
    words = text.split()
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # older NumPy warns, and leaves the rest out
        try:
            values = np.fromstring(text, dtype, sep=" ")
            if len(values) == len(words):  # "- 1" is one number to NumPy
                return values
        except (ValueError, DeprecationWarning):
            pass
    for word in words:
        try:
            dtype(word)
        except (ValueError, OverflowError):
            raise BadFile(f"{word[:40]!r} is not a number; export it again") from None
    raise BadFile("a number is broken; export it again")
