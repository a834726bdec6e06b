"""Laws of the training loop: interruptions change nothing, what is not finite is not kept."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.regression import INIT, batches, config, loss_fn

from flx.config import Train
from flx.training.checkpoint import Checkpoints
from flx.training.loop import TrainState, averaged, initial_state, make_step, restore, train
from flx.training.run import Run


def rows_of(run: Run) -> list[dict[str, float]]:
    with open(run.metrics, newline="") as file:
        return [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]


def without_clock(rows: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def assert_same_bits(a: TrainState, b: TrainState):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


class PowerCut(Exception):
    """What stops a run in these tests."""


def cut_at(step: int) -> Any:
    def failing(n: int) -> Any:
        if n == step:
            raise PowerCut(n)
        return batches(n)

    return failing


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> tuple[Run, TrainState]:
    run = Run(tmp_path_factory.mktemp("runs") / "whole")
    return run, train(run, config, INIT, loss_fn, batches)


def test_training_trains(uninterrupted):
    run, state = uninterrupted
    assert int(state.step) == len(rows_of(run)) == 12
    key = jax.random.key(0)
    before, after = (
        np.mean([loss_fn(p, batches(n), key)[0] for n in range(20)]) for p in (INIT, averaged(state, INIT))
    )
    assert after < 0.75 * before
    assert not any(x.is_deleted() for x in jax.tree.leaves(INIT))  # the caller's arrays are its own


@pytest.mark.parametrize("cut", [2, 7, 11])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, uninterrupted, cut):
    whole, state = uninterrupted
    run = Run(tmp_path / "cut")
    with pytest.raises(PowerCut):
        train(run, config, INIT, loss_fn, cut_at(cut))
    seen = []

    def watched(step: int) -> Any:
        seen.append(step)
        return batches(step)

    resumed = train(run, config, INIT, loss_fn, watched)
    assert seen[0] == cut // 5 * 5  # it went on from the checkpoint
    assert_same_bits(resumed, state)
    assert [row["step"] for row in rows_of(run)] == list(range(1, 13))
    assert without_clock(rows_of(run)) == without_clock(rows_of(whole))
    assert run.metrics.read_text().count("step,") == 1
    assert_same_bits(restore(run, config, jax.eval_shape(lambda: INIT)), state)


@pytest.mark.slow
def test_a_killed_run_is_the_uninterrupted_one(tmp_path, uninterrupted):
    """`kill -9` a training process after its second checkpoint, then train on in another."""
    run = Run(tmp_path / "killed")
    slow = (
        "import sys, time; from pathlib import Path; from helpers import regression as r\n"
        "from flx.training.loop import train; from flx.training.run import Run\n"
        "def slow(n): time.sleep(0.0 if n < 11 else 60); return r.batches(n)\n"
        "train(Run(Path(sys.argv[1])), r.config, r.INIT, r.loss_fn, slow)"
    )
    command = [sys.executable, "-c", slow, str(run.folder)]  # -c: modules are looked for where it starts
    child = subprocess.Popen(command, cwd=Path(__file__).parents[1], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not (run.checkpoints / "10").exists():
        assert child.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    child.kill()
    assert child.wait() == -signal.SIGKILL
    with open(run.metrics, "a") as file:
        file.write("1")  # of a row "11,…": a kill may tear it
    resumed = train(run, config, INIT, loss_fn, batches)
    assert_same_bits(resumed, uninterrupted[1])
    assert without_clock(rows_of(run)) == without_clock(rows_of(uninterrupted[0]))


@pytest.mark.skipif(os.name != "posix", reason="elsewhere a process cannot send itself a signal to answer")
@pytest.mark.parametrize("number, status", [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_run_saves_and_goes_on(tmp_path, uninterrupted, number, status, capsys):
    run = Run(tmp_path / "stopped")
    usual = signal.getsignal(number)

    def stopping(step: int) -> Any:
        if step == 7:
            os.kill(os.getpid(), number)
        return batches(step)

    with pytest.raises(SystemExit) as stopped:
        train(run, config, INIT, loss_fn, stopping)
    assert stopped.value.code == status and signal.getsignal(number) is usual
    at = Checkpoints(run.checkpoints).latest_step
    assert at is not None and 5 <= at < 12 and f"saved at step {at};" in capsys.readouterr().err
    assert_same_bits(train(run, config, INIT, loss_fn, batches), uninterrupted[1])
    assert [row["step"] for row in rows_of(run)] == list(range(1, 13))


def test_a_finished_run_is_returned_as_it_is(uninterrupted):
    run, state = uninterrupted
    assert_same_bits(train(run, config, INIT, loss_fn, cut_at(0)), state)


def test_rows_are_means_and_part_the_steps(tmp_path, uninterrupted):
    run = Run(tmp_path / "rows")
    coarse = Train(**{**vars(config), "log_every": 3})
    with pytest.raises(PowerCut):
        train(run, coarse, INIT, loss_fn, cut_at(9))
    train(run, coarse, INIT, loss_fn, batches)
    fine, rows = rows_of(uninterrupted[0]), rows_of(run)
    ends = [int(row["step"]) for row in rows]
    assert ends == [3, 5, 6, 9, 10, 12]
    for first, row in zip([0, *ends], rows, strict=False):
        for name in ("loss", "worst", "gradient_norm"):
            mean = np.mean([r[name] for r in fine[first : int(row["step"])]])
            np.testing.assert_allclose(row[name], mean, rtol=1e-5)
    assert list(run.events.iterdir())


@pytest.mark.parametrize("bad", [0, 3, 5, 8])
def test_the_first_number_not_finite_ends_the_run(tmp_path, bad):
    run = Run(tmp_path / "bad")

    def poisoned(step: int) -> Any:
        batch = batches(step)
        batch["y"][0] = np.nan if step == bad else batch["y"][0]
        return batch

    with pytest.raises(FloatingPointError) as error:
        train(run, config, INIT, loss_fn, poisoned)
    told = str(error.value)
    kept = "there is no checkpoint yet" if bad < 5 else "the last checkpoint is step 5"
    assert f"step {bad + 1} gave loss = nan" in told and kept in told and "\n" not in told
    assert "train.learning_rate (0.1)" in told and "train.clip" in told
    assert all(np.isfinite(list(row.values())).all() and row["step"] <= bad for row in rows_of_any(run))
    if bad >= 5:
        state = restore(run, config, INIT)
        assert int(state.step) == 5 and all(np.isfinite(x).all() for x in jax.tree.leaves(state))


def rows_of_any(run: Run) -> list[dict[str, float]]:
    return rows_of(run) if run.metrics.exists() else []


def test_a_gradient_that_is_not_finite_is_caught_at_its_step_and_not_saved(tmp_path):
    """√|w| at w = 0 has a finite value and no finite slope; a checkpoint is due at that very step."""

    def kinked(params: Any, batch: Any, key: Any) -> Any:
        return jnp.sqrt(jnp.abs(batch["x"][0, 0] * params["w"][0, 0])), {}

    def flat_at_4(step: int) -> Any:
        return {"x": np.full((1, 1), step != 4, np.float32)}

    run = Run(tmp_path / "kink")
    with pytest.raises(
        FloatingPointError, match=r"step 5 gave gradient_norm = (nan|inf); there is no checkp"
    ):
        train(run, config, INIT, kinked, flat_at_4)
    with pytest.raises(ValueError, match="no checkpoint yet"):
        restore(run, config, INIT)


def test_the_average_is_its_closed_form():
    """e_n = Σ_k w_k p_k with w_k = (1 − d_k) Π_{j>k} d_j, over parameters that SGD cannot hide."""
    toy = Train(steps=40, learning_rate=0.1, final_learning_rate=0.1, ema=0.7)
    start = jnp.array([5.0, -3.0])
    step = jax.jit(make_step(toy, lambda p, b, k: (jnp.sum((p - b) ** 2), {}), start))
    state = initial_state(toy, start)
    visited = [np.float64(state.params["rest"])]
    for n in range(40):
        state, _ = step(state, jnp.array([np.sin(n), 1.0], jnp.float32))
        visited.append(np.float64(state.params["rest"]))
    decays = [min(0.7, (1 + n) / (10 + n)) for n in range(40)]
    assert 0.7 in decays and 0.1 in decays
    weights = [np.prod(decays)] + [(1 - decays[k]) * np.prod(decays[k + 1 :]) for k in range(40)]
    assert np.isclose(sum(weights), 1) and weights[0] < 1e-6
    np.testing.assert_allclose(state.ema["rest"], np.dot(weights, visited), rtol=1e-5)
    assert np.abs(np.asarray(state.ema["rest"] - state.params["rest"])).max() > 1e-3


def test_steps_draw_from_their_own_key():
    """The key of step n is fold_in(seed, n), for any way to reach step n."""
    step = make_step(config, lambda p, b, key: (jnp.sum(p**2), {"u": jax.random.uniform(key)}), jnp.ones(2))
    state = initial_state(config, jnp.ones(2))
    drawn = []
    for _ in range(3):
        state, scalars = step(state, None)
        drawn.append(float(scalars["u"]))
    expected = [float(jax.random.uniform(jax.random.fold_in(jax.random.key(3), n))) for n in range(3)]
    assert drawn == expected and len(set(drawn)) == 3


@pytest.mark.parametrize(
    "change, told",
    [
        (dict(steps=0), "train.steps is 0"),
        (dict(warmup=-1), "train.warmup is -1"),
        (dict(ema=1.0), "train.ema is 1.0"),
        (dict(learning_rate=-1.0), "train.learning_rate is -1.0"),
    ],
)
def test_a_configuration_that_cannot_train_is_refused(tmp_path, change, told):
    with pytest.raises(ValueError, match=told):
        train(Run(tmp_path / "no"), Train(**{**vars(config), **change}), INIT, loss_fn, batches)


def test_what_is_saved_beside_a_checkpoint_is_never_behind_it(tmp_path, monkeypatch):
    """A kill between the two would else leave it behind for ever, were that checkpoint the last."""
    order, checkpoint = [], Checkpoints.save
    monkeypatch.setattr(
        Checkpoints, "save", lambda self, n, state: (order.append(-n), checkpoint(self, n, state))[1]
    )
    state = train(Run(tmp_path / "order"), config, INIT, loss_fn, batches, lambda n, ema: order.append(n))
    steps = order[::2]
    assert len(steps) > 1 and steps[-1] == int(state.step) and order[1::2] == [-n for n in steps]


def test_what_is_saved_beside_a_checkpoint_is_the_average(tmp_path):
    saved = []
    state = train(Run(tmp_path / "mean"), config, INIT, loss_fn, batches, lambda n, ema: saved.append(ema))
    jax.tree.map(np.testing.assert_array_equal, saved[-1], averaged(state, INIT))
    assert any((state.ema[name] != state.params[name]).any() for name in state.ema)
