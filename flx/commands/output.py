"""The folder that a verb writes to: no result replaces that of another call.

A JSON record in the folder says what made its files. The same call writes the same files again. Another call
gets a folder of its own, named after the options that are not the usual ones.
"""

import hashlib
import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

from flx.files import check_place

# Options on which no mesh that is written depends.
APART = ("run", "out", "count", "up", "viewer", "beside", "instant")


def settings(options: Any, apart: Collection[str] = APART) -> dict[str, Any]:
    """The options that the files of a call depend on, as JSON holds them; not its input, which has none."""
    return {name: value for name, value, _ in _set(options, apart)}


def digests(files: Mapping[str, Path | None]) -> dict[str, str]:
    """What the files that options name hold, by the names of the options: other content is another call."""
    return {f"{name}_digest": digest(path) for name, path in files.items() if path}


def digest(path: Path) -> str:
    """Of what a file holds: the start of its SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12]


def own_folder(
    options: Any,
    usual: Path,
    also: str,
    record: str,
    wanted: dict[str, Any],
    files: Iterable[str],
    apart: Collection[str] = APART,
) -> tuple[Path, dict[str, Any]]:
    """The folder of a call, and what its record says so far ({} for a new folder).

    It is `options.out` if that is given. Else it is `usual`, with the options that are not the usual ones in
    its name; where that holds the files of another call, also `also`; then a number.

    A folder is that of another call if its record differs from `wanted`, or if it has no record but some of
    the `files`. Raises ValueError where `options.out` is, and where no folder can be made.
    """
    files = list(files)
    if options.out is not None:
        check_place(options.out / record)
        before = _record(options.out / record)
        if differs := _differences(options.out, before, wanted, files):
            raise ValueError(
                f"{options.out} holds the files of another call ({differs}); name another folder with "
                "--out, or leave it out for one of its own"
            )
        return options.out, before or {}
    odd = [(name, value) for name, value, default in _set(options, apart) if value != default]
    words = [f"{name}-{_word(value)}".replace("_", "-") for name, value in odd]
    name = "-".join([usual.name, *words])
    for end in chain(("", f"-{also}"), (f"-{also}-{n}" for n in count(2))):
        folder = usual.with_name(name + end)
        check_place(folder / record)
        before = _record(folder / record)
        if not _differences(folder, before, wanted, files):
            return folder, before or {}
    raise AssertionError


def _set(options: Any, apart: Collection[str]) -> Iterator[tuple[str, Any, Any]]:
    """The name, value and default of each option, also of those that are grouped; not of those `apart`."""
    for f in fields(options):
        value = getattr(options, f.name)
        if is_dataclass(value):
            yield from _set(value, apart)
        elif f.default is not MISSING and f.name not in apart:
            yield f.name, _plain(value), _plain(f.default)


def _differences(
    folder: Path, before: dict[str, Any] | None, wanted: dict[str, Any], files: list[str]
) -> str:
    """What was another when the files in a folder were made; "" if nothing was, or there are none."""
    if before is None:
        return next((f"{name} is there" for name in files if (folder / name).exists()), "")
    unlike = {name: before.get(name, "unknown") for name in wanted}
    return ", ".join(f"{n} = {unlike[n]}, not {wanted[n]}" for n in wanted if unlike[n] != wanted[n])


def _record(path: Path) -> dict[str, Any] | None:
    """What a record says: None without one, {} for one that cannot be read."""
    if not path.exists():
        return None
    try:
        record = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=str))


def _word(value: Any) -> str:
    return re.sub(r"\W+", "-", str(value)).strip("-")[-40:]
