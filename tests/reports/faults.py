"""A tiny run that is killed, stopped, damaged and starved of disk, and what the next call makes of it.

python tests/reports/faults.py [kills] [damages] [disks] [signals] prints the table, of all four unless some
are named. It ends with 1 if anything was lost, took more than its lines or ended in a traceback. Full disks
need the right to mount a tmpfs; without it these rows are left out, as the table says.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

sys.path.append(str(Path(__file__).parents[1]))  # a script finds what lies beside it, not helpers
from helpers.files import colored_ball

from flx.pipeline.codec import digest_of
from flx.training.load import load_generator

SMOKE = Path(__file__).parents[2] / "experiments" / "smoke.py"
STEPS = 30
TRAIN = (
    f"train {SMOKE} --surface.path ball.ply --name tiny --workers 1 --surface.vertices 200 "
    "--surface.copies 3 --model.channels 4 --model.embedding 8 --train.checkpoint-every 5 "
    f"--train.log-every 5 --train.steps {STEPS}"
)
USUAL = (
    "copies:",
    "each vertex sees",
    "compiled the train step",
    "resumed at",
    "learnt; flx sample",
    "step ",
)
KILLS, SIZES = 20, (0.02, 0.2, 0.45, 0.7, 0.95)  # sizes of disks, as shares of what a run takes
FILES = {  # a file of a run of each kind, as a pattern
    "config.json": "config.json",
    "asset": "asset/files/ball.ply",
    "copy": "prepared/*0000.npz",
    "tables of a copy": "prepared/*0000.tables.npz",
    "state of the newest checkpoint": f"checkpoints/{STEPS}/default/d/*",
    "manifest of the newest checkpoint": f"checkpoints/{STEPS}/default/manifest.ocdbt",
    "digest of the newest checkpoint": f"checkpoints/{STEPS}/digest",
    "generator": "generator.safetensors",
    "metrics": "metrics.csv",
    "events": "events/*",
    "lock": ".lock",
}
PHASES = {  # a command, what to wait for (a word on stderr, or a file), more seconds
    "starting": (TRAIN, "", 0.7),
    "copies": (TRAIN.replace("copies 3", "copies 60"), "runs/tiny/prepared", 1.0),
    "compiling": (TRAIN, "each vertex sees", 0.5),
    "training": (TRAIN.replace(f"steps {STEPS}", "steps 100000"), "compiled the train step", 1.0),
    "reconstructing": ("reconstruct ball.ply --vertices 20000", "encoding", 0.2),
}


class Row(NamedTuple):
    what: str
    right: bool
    status: int
    told: str


def start(words: str, folder: Path, cache: Path | None, log: Path | None = None) -> subprocess.Popen:
    with open(log or folder / "log", "w") as stderr:
        return subprocess.Popen(
            [sys.executable, "-m", "flx.launch", *words.split()],
            cwd=folder,
            stderr=stderr,
            stdout=subprocess.DEVNULL,
            env={**os.environ, "FLX_CACHE": str(cache or "")},
            start_new_session=True,
        )


def ended(words: str, folder: Path, cache: Path, log: Path | None = None) -> tuple[int, list[str]]:
    """The status of a command, and its lines that are not the usual ones."""
    log = log or folder / "log"
    return start(words, folder, cache, log).wait(600), unusual(log)


def unusual(log: Path) -> list[str]:
    lines = [line.split("\r")[-1].strip() for line in log.read_text().splitlines()]
    return [line for line in lines if line and not any(word in line for word in USUAL)]


def digest(folder: Path) -> str:
    """Of what the run learnt."""
    return digest_of(load_generator(folder / "runs" / "tiny").params)


def steps_are_there_once(folder: Path) -> bool:
    rows = (folder / "runs" / "tiny" / "metrics.csv").read_text().splitlines()[1:]
    return [int(row.split(",")[0]) for row in rows] == list(range(5, STEPS + 1, 5))


def kills(folder: Path, cache: Path, wanted: str, seconds: float) -> Iterator[Row]:
    """kill -9 at random times, each followed by the same command; then all must be as if nothing had been."""
    times = random.Random(0)
    for n in range(KILLS):
        child = start(TRAIN, folder, cache)
        wait = times.uniform(0.3, 1.0) * seconds
        try:
            child.wait(wait)
        except subprocess.TimeoutExpired:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        told = unusual(folder / "log")
        if child.returncode == 0:  # it was ready before: one is begun anew
            right = not told and digest(folder) == wanted and steps_are_there_once(folder)
            yield Row(f"kill {n}: not before it was ready", right, 0, " / ".join(told))
            shutil.rmtree(folder / "runs")
        else:
            yield Row(f"kill {n} after {wait:.1f} s", not told, child.returncode, " / ".join(told))
    status, told = ended(TRAIN, folder, cache)
    right = status == 0 and not told and digest(folder) == wanted and steps_are_there_once(folder)
    yield Row("after all kills: the same network, each step once", right, status, " / ".join(told))


def folder_instead(path: Path) -> None:
    path.unlink()
    (path / "x").mkdir(parents=True)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes()) or bytearray(1)
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "cut in half": lambda path: os.truncate(path, path.stat().st_size // 2),
    "a flipped bit": flip,
    "deleted": lambda path: path.unlink(),
    "a folder in its place": folder_instead,
}


def damages(folder: Path, cache: Path, wanted: str, whole: Path) -> Iterator[Row]:
    """Of a finished run: the same command either mends it, or says in one line what is wrong."""
    for kind, pattern in FILES.items():
        for name, damage in DAMAGES.items():
            shutil.rmtree(folder / "runs", ignore_errors=True)
            shutil.copytree(whole, folder / "runs" / "tiny")
            path = max((folder / "runs" / "tiny").glob(pattern), key=lambda path: path.stat().st_size)
            damage(path)
            status, told = ended(TRAIN, folder, cache)
            if status == 0:
                right = len(told) <= 1 and digest(folder) == wanted
            else:
                right = status in (1, 2) and len(told) == 1 and told[0].startswith("flx: ")
            yield Row(f"{kind}: {name}", right, status, " / ".join(told))


def disks(folder: Path, cache: Path, wanted: str, size: int) -> Iterator[Row]:
    """On a disk that is too small, and again when there is room."""
    for share in SIZES:
        disk = folder / "disk"
        disk.mkdir()
        small = ["mount", "-t", "tmpfs", "-o", f"size={int(share * size)}", "tmpfs", str(disk)]
        if subprocess.run(small, capture_output=True).returncode:
            disk.rmdir()
            yield Row("full disk: not tried, since no tmpfs can be mounted", True, 0, "")
            return
        try:
            shutil.copy(folder / "ball.ply", disk / "ball.ply")
            status, told = ended(TRAIN, disk, cache, folder / "log")
            right = status == 1 and len(told) == 1 and "disk is full" in told[0]
            yield Row(f"a disk of {int(share * size):,} bytes", right, status, " / ".join(told))
            subprocess.run(["mount", "-o", "remount,size=1g", str(disk)], check=True)
            status, told = ended(TRAIN, disk, cache, folder / "log")
            right = status == 0 and not told and digest(disk) == wanted
            yield Row("the same with room again", right, status, " / ".join(told))
        finally:
            subprocess.run(["umount", str(disk)], check=True)
            disk.rmdir()


def is_there(folder: Path, sign: str) -> bool:
    """A file, or a word that was said."""
    return (folder / sign).exists() if "/" in sign else sign in (folder / "log").read_text()


def signals(folder: Path) -> Iterator[Row]:
    """In every phase: one line, the status of the signal, within three seconds."""
    for phase, (words, sign, seconds) in PHASES.items():
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            shutil.rmtree(folder / "runs", ignore_errors=True)
            child = start(words, folder, None)
            while child.poll() is None and not is_there(folder, sign):
                time.sleep(0.05)
            time.sleep(seconds)
            began = time.monotonic()
            os.killpg(child.pid, number)
            status = child.wait(60)
            took = time.monotonic() - began
            told = [line for line in unusual(folder / "log") if not line[:1].isdigit()]  # stages are numbered
            stops = [line for line in told if "stopped" in line]
            right = status == 128 + number and len(stops) == len(told) == 1 and took < 6
            yield Row(f"{number.name} while {phase} ({took:.1f} s)", right, status, " / ".join(told))


def main() -> int:
    chosen = sys.argv[1:] or ["kills", "damages", "disks", "signals"]
    with TemporaryDirectory() as name:
        folder, cache = Path(name) / "work", Path(name) / "cache"
        folder.mkdir()
        colored_ball(folder)
        first, told = ended(TRAIN, folder, cache)
        assert first == 0, told
        shutil.rmtree(folder / "runs")
        began = time.monotonic()
        ended(TRAIN, folder, cache)  # with compiled programs, as all others
        seconds = time.monotonic() - began
        wanted, whole = digest(folder), Path(name) / "whole"
        shutil.copytree(folder / "runs" / "tiny", whole)
        size = sum(path.stat().st_size for path in whole.rglob("*") if path.is_file())
        shutil.rmtree(folder / "runs")
        made = {
            "kills": lambda: kills(folder, cache, wanted, seconds),
            "damages": lambda: damages(folder, cache, wanted, whole),
            "disks": lambda: disks(folder, cache, wanted, size),
            "signals": lambda: signals(folder),
        }
        wrong = count = 0
        print("| fault | right | status | told |\n|---|---|---|---|", flush=True)
        for part in chosen:
            shutil.rmtree(folder / "runs", ignore_errors=True)
            for row in made[part]():
                count, wrong = count + 1, wrong + (not row.right)
                said = row.told.replace(str(folder) + "/", "")[:400]
                print(f"| {row.what} | {'yes' if row.right else 'NO'} | {row.status} | {said} |", flush=True)
        print(json.dumps({"rows": count, "wrong": wrong, "seconds of a run": round(seconds, 1)}))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
