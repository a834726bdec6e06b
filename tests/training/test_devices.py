"""Laws of training on several devices and in several processes: what is learnt hangs on neither."""

import csv
import os
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.job import BATCH, INIT, config, learn, loss_fn, whole_batch
from helpers.processes import TESTS, said, wait_until
from hypothesis import given
from hypothesis import strategies as st

from flx.training.checkpoint import Checkpoints
from flx.training.devices import devices_for
from flx.training.hosts import Host, joined
from flx.training.loop import in_parts, initial_state
from flx.training.run import Run

posix = pytest.mark.skipif(os.name != "posix", reason="signals as POSIX has them")
MOST = 60.0  # seconds until the others have noticed a death


def process(folder: Path, hosts: str = "", steps: int = 50, devices: int = 1) -> subprocess.Popen:
    """The training as a process with simulated devices."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    command = [sys.executable, "-m", "helpers.job", str(folder), str(steps), hosts]
    environment = os.environ | {
        "XLA_FLAGS": flags,
        "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)]),
    }
    return subprocess.Popen(
        command, cwd=TESTS, env=environment, stderr=subprocess.PIPE, start_new_session=True
    )


def pair(folder: Path, steps: int = 50) -> list[subprocess.Popen]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return [process(folder, f"{n}/2@127.0.0.1:{port}", steps) for n in range(2)]


def pair_under_way(folder: Path) -> list[subprocess.Popen]:
    """Two processes that have saved and go on."""
    both = pair(folder, steps=100_000)
    wait_until(lambda: (folder / "checkpoints" / "20").exists())
    return both


def state_in(folder: Path) -> Any:
    found = Checkpoints(Run(folder).checkpoints).restore_latest(initial_state(config, INIT))
    assert found
    return found[1]


def losses(folder: Path) -> list[float]:
    with open(Run(folder).metrics, newline="") as file:
        return [float(row["loss"]) for row in csv.DictReader(file)]


def assert_same(a: Path, b: Path):
    assert len(losses(a)) == 50
    np.testing.assert_allclose(losses(a), losses(b), rtol=1e-5)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-7), state_in(a), state_in(b)
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "alone"
    learn(folder, Host(), 1)
    return folder


@given(parts=st.sampled_from([1, 2, 4, 8]), step=st.integers(0, 100))
def test_a_batch_in_parts_gives_what_it_gives_at_once(parts, step):
    arguments = INIT, whole_batch(step), jax.random.key(step)
    (loss, _), slope = in_parts(loss_fn, 1)(*arguments)
    (ours, _), our_slope = in_parts(loss_fn, parts)(*arguments)
    np.testing.assert_allclose(ours, loss, rtol=1e-5)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), our_slope, slope)


def test_parts_and_one_after_the_other_train_alike(alone, tmp_path):
    learn(tmp_path / "parts", Host(), 1, parts=4)
    assert_same(tmp_path / "parts", alone)


@pytest.mark.slow
def test_four_devices_learn_what_one_does_and_one_goes_on(alone, tmp_path):
    """The first 30 steps on four devices, the rest on one."""
    first = process(tmp_path / "four", steps=50, devices=4)
    assert first.wait() == 0, said(first)
    assert_same(tmp_path / "four", alone)
    (tmp_path / "some").mkdir()
    stopped = process(tmp_path / "some", steps=30, devices=4)
    assert stopped.wait() == 0, said(stopped)
    assert int(state_in(tmp_path / "some").step) == 30
    learn(tmp_path / "some", Host(), 1, steps=40)
    assert int(state_in(tmp_path / "some").step) == 40


@pytest.mark.slow
@posix
def test_two_processes_learn_what_one_does_and_one_writes(alone, tmp_path):
    both = pair(tmp_path / "two")
    words = [said(child) for child in both]
    assert [child.wait() for child in both] == [0, 0], words
    assert "50 steps done" in words[0] and "steps" not in words[1]
    assert_same(tmp_path / "two", alone)


@pytest.mark.slow
@posix
@pytest.mark.parametrize("dies", [0, 1])
def test_when_a_process_is_killed_the_other_ends_in_one_line_and_one_alone_goes_on(dies, tmp_path):
    both = pair_under_way(tmp_path / "cut")
    both[dies].kill()
    words = said(both[1 - dies])
    assert both[1 - dies].wait(MOST) == 1
    last = words.replace("\r", "\n").strip().splitlines()[-1]
    assert "of this training has ended; " in last and "the same command goes on" in last
    assert "Traceback" not in words and "***" not in words
    done = int(state_in(tmp_path / "cut").step)
    learn(tmp_path / "cut", Host(), 1, steps=done + 5)
    assert int(state_in(tmp_path / "cut").step) == done + 5


@pytest.mark.slow
@posix
@pytest.mark.parametrize("told", [0, 1])
def test_a_signal_to_one_process_stops_all_at_the_same_saved_step(told, tmp_path):
    both = pair_under_way(tmp_path / "told")
    both[told].send_signal(signal.SIGTERM)
    words = [said(child) for child in both]
    assert [child.wait(MOST) for child in both] == [143, 143], words
    assert f"stopped, saved at step {state_in(tmp_path / 'told').step}" in words[0]


def test_rows_are_shared_among_processes_and_devices_in_order():
    mesh = devices_for(BATCH).mesh
    shares = [devices_for(BATCH)._replace(host=Host(n, 4)).rows(BATCH) for n in range(4)]
    assert [row for share in shares for row in range(BATCH)[share]] == [*range(BATCH)]
    assert mesh.axis_names == ("rows",)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((4, 1, 9999), "--devices is 9999, but there are"),
        ((3, 1, 1, Host(0, 2)), "train.batch is 3, which 2 devices cannot share; make it a multiple of 2"),
        ((4, 4, 1, Host(0, 2)), "train.batch is 4, in 4 parts, which 2 devices cannot share"),
    ],
)
def test_what_devices_cannot_share_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        devices_for(*arguments)


@pytest.mark.parametrize("hosts", ["2/2@127.0.0.1:99", "0/2", "0/2@:99", "0/2@host", "a/b@c:1", ""])
def test_words_that_name_no_process_are_refused(hosts):
    with pytest.raises(ValueError, match=r"--hosts is .*give NUMBER/COUNT@ADDRESS:PORT"), joined(hosts):
        pass


def test_parts_divide_the_batch():
    with pytest.raises(
        ValueError, match=r"train\.accumulate is 3; give a number that divides train.batch, 8"
    ):
        replace(config, accumulate=3)
