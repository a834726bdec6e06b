"""Laws of Ctrl-C, SIGTERM and SIGHUP: one line, the status of the signal, at once and wherever it is."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from helpers.processes import python, said, wait_until

from flx.stopping import SIGNALS, Noted, ended_by_signals

WORKING = """
import hashlib, signal, sys, time
from pathlib import Path
from tqdm import tqdm
from flx.files import temporary_folder, write_atomically
from flx.stopping import Noted, ended_by_signals, keeping

folder = Path(sys.argv[1])

def ready():
    (folder / "ready").touch()

def in_python():
    ready()
    while True:
        sum(range(1000))

def in_c():  # as XLA when it compiles: no step of Python for minutes
    ready()
    hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)

def in_a_file():
    kept = temporary_folder()
    Path(kept.name, "half").touch()
    (folder / "temporary").write_text(kept.name)
    write_atomically(folder / "whole", lambda torn: (torn.write_bytes(b"half"), ready(), time.sleep(60)))

def noting():
    with Noted() as stop:
        ready()
        while stop.signal is None:
            time.sleep(0.01)
        (folder / "noted").touch()
        in_c()

with ended_by_signals():
    keeping(lambda: "3 of 8 are kept; go on")
    with tqdm(total=8, desc="work"):
        globals()[sys.argv[2]]()
"""


def stop(work: str, number: int, folder: Path, times: int = 1) -> tuple[int, str, float]:
    """Status, the last line on stderr and the seconds until the end, for a signal in the midst of `work`."""
    child = python(WORKING, str(folder), work)
    wait_until((folder / "ready").exists)
    for _ in range(times - 1):
        child.send_signal(number)
        wait_until((folder / "noted").exists)
    began = time.monotonic()
    child.send_signal(number)
    told, status = said(child), child.wait(60)
    assert told.count("\n") == 1, told
    return status, told.split("\r")[-1].strip(), time.monotonic() - began


@pytest.mark.parametrize(
    ("work", "number"), [("in_python", signal.SIGINT), *(("in_c", number) for number in SIGNALS)]
)
def test_a_signal_ends_the_process_with_one_line_and_its_status(tmp_path, work, number):
    status, line, seconds = stop(work, number, tmp_path)
    assert status == 128 + number and seconds < 3
    assert line == f"flx: stopped by {number.name}; 3 of 8 are kept; go on"


def test_it_leaves_neither_a_torn_file_nor_a_temporary_folder(tmp_path):
    assert stop("in_a_file", signal.SIGTERM, tmp_path)[0] == 128 + signal.SIGTERM
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ready", "temporary"]
    temporary = (tmp_path / "temporary").read_text()
    assert temporary and not Path(temporary).exists()


def test_a_loop_that_notes_the_first_signal_is_ended_by_the_second(tmp_path):
    status, line, seconds = stop("noting", signal.SIGINT, tmp_path, times=2)
    assert status == 128 + signal.SIGINT and "3 of 8 are kept" in line and seconds < 3


def test_a_step_that_goes_on_after_a_signal_is_explained(tmp_path):
    script = "import flx.stopping; flx.stopping.PATIENCE = 0.2\n" + WORKING
    child = python(script, str(tmp_path), "noting")
    wait_until((tmp_path / "ready").exists)
    child.send_signal(signal.SIGINT)
    assert child.stderr
    line = child.stderr.readline().decode().split("\r")[-1]
    child.kill()
    assert line == "flx: stopping after this step, to save it; a second signal stops at once\n"


def test_a_signal_that_is_ignored_stays_ignored(tmp_path):
    """As under nohup, and for Ctrl-C in the background of a script."""
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    child = python(ignoring + WORKING, str(tmp_path), "in_python")
    wait_until((tmp_path / "ready").exists)
    child.send_signal(signal.SIGHUP)
    time.sleep(0.3)
    assert child.poll() is None
    child.send_signal(signal.SIGTERM)
    assert child.wait(60) == 128 + signal.SIGTERM


def test_the_usual_handlers_come_back():
    before = [signal.getsignal(number) for number in SIGNALS]
    with ended_by_signals():
        assert all(signal.getsignal(n) is not b for n, b in zip(SIGNALS, before, strict=True))
    assert [signal.getsignal(number) for number in SIGNALS] == before
    wait_until(lambda: all(thread.name != "signals" for thread in threading.enumerate()), 5)


def test_in_a_process_of_ones_own_the_first_signal_is_noted_and_the_second_is_as_usual():
    """A notebook has no thread that ends it."""
    with pytest.raises(KeyboardInterrupt), Noted() as noted:
        os.kill(os.getpid(), signal.SIGINT)
        assert noted.signal == signal.SIGINT
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


# --- the command itself

TABLE = "evaluate --reconstruction vase.glb --vertices 600 --texture-size 128 --methods vertex_colours inf"
PHASES = {  # a command, a word on stderr or a file to wait for, more seconds to wait, what is said
    "copies": ("train SMOKE --surface.copies 40", "runs/smoke/prepared", 1.0, "of 40 copies are kept in"),
    "compiling": ("train SMOKE", "each vertex sees", 2.0, "no step is saved yet, what is prepared is kept"),
    "reconstruct": ("reconstruct vase.glb --vertices 20000", "", 6.0, "nothing new is kept"),
    "evaluate": (TABLE, "evaluation/table.json", 0.5, "1 of 2 rows are kept in evaluation"),
}


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_a_command_is_ended_in_every_phase(tmp_path, phase):
    from flx.assets.asset import own_painting
    from flx.assets.vase import vase_asset
    from flx.assets.write import write

    write(asset := vase_asset(), own_painting(asset), tmp_path / "vase.glb")
    words, sign, seconds, kept = PHASES[phase]
    smoke = str(Path(__file__).parents[1] / "experiments" / "smoke.py")
    command = [sys.executable, "-m", "flx.launch", *words.replace("SMOKE", smoke).split()]
    log, fresh = tmp_path / "log", {**os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"}
    with open(log, "w") as stderr:
        child = subprocess.Popen(
            command, cwd=tmp_path, stderr=stderr, env=fresh, stdout=subprocess.DEVNULL, start_new_session=True
        )
    there = (tmp_path / sign).exists if "/" in sign else lambda: sign in log.read_text()
    wait_until(lambda: there() or child.poll() is not None, 300)
    time.sleep(seconds)
    assert child.poll() is None, log.read_text()
    os.killpg(child.pid, signal.SIGINT)
    began = time.monotonic()
    assert child.wait(60) == 130 and time.monotonic() - began < 6  # about one on quiet cores
    told = log.read_bytes().decode()
    line = told.split("\n")[-2].split("\r")[-1]
    assert line.startswith("flx: stopped by SIGINT; ") and kept in line
    assert told.count("\n") <= 3 and "Traceback" not in told  # the bar, the network, this line
