"""What this machine gives to this process: processors and memory."""

import contextlib
import os
import shutil
from pathlib import Path
from typing import NamedTuple

CGROUPS = Path("/sys/fs/cgroup")  # Linux: the limits of containers


class Memory(NamedTuple):
    """In bytes."""

    total: float
    free: float


def processors() -> int:
    """How many processors this process may use."""
    if hasattr(os, "process_cpu_count"):  # from Python 3.13 on
        return os.process_cpu_count() or 1  # pyright: ignore[reportAttributeAccessIssue]
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def room(folder: Path = Path()) -> float | None:
    """Free bytes on the disk of a folder; None where the system does not say."""
    try:
        return float(shutil.disk_usage(folder).free)
    except OSError:
        return None


def memory() -> Memory | None:
    """Memory within the limits of the container; None where the system does not say (Windows)."""
    try:
        total = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return None
    try:
        free = 1024.0 * _numbers(Path("/proc/meminfo"))["MemAvailable:"]
    except (OSError, KeyError):  # macOS
        free = total
    for folder in _containers():
        try:
            limit = float((folder / "memory.max").read_text())  # "max" where there is none
            cached = _numbers(folder / "memory.stat")["inactive_file"]
            used = float((folder / "memory.current").read_text()) - cached
        except (OSError, ValueError, KeyError):
            continue
        total, free = min(total, limit), min(free, limit - used)
    return Memory(total, max(free, 0.0))


def _containers() -> list[Path]:
    """The group of this process and all around it."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []
    own = [CGROUPS / line.removeprefix("0::/") for line in lines if line.startswith("0::/")]
    return [folder for path in own for folder in (path, *path.parents) if folder.is_relative_to(CGROUPS)]


def _numbers(path: Path) -> dict[str, float]:
    """The second word of each line, by the first."""
    return {words[0]: float(words[1]) for words in map(str.split, path.read_text().splitlines())}


def yield_to_others() -> None:
    """From here on this process, which serves others, runs when they leave a processor free; for good.

    Linux may share processors among sessions first, so it begins one of its own, which yields as a whole.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.setsid()
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19")
    with contextlib.suppress(AttributeError, OSError):
        os.nice(19)
