"""Law of progress: without a terminal it is told in lines."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
from helpers.regression import INIT, batches, config, loss_fn
from tensorboardX.proto.event_pb2 import Event, SessionLog

from flx.training.checkpoint import Checkpoints
from flx.training.log import Log, _drop_rows_after
from flx.training.loop import train
from flx.training.run import Run


def test_without_a_terminal_progress_is_told_in_lines(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("flx.training.log._SILENCE", 0.0)
    train(Run(tmp_path / "lines"), config, INIT, loss_fn, batches)
    lines = capsys.readouterr().err.splitlines()
    assert "compiled the train step in" in lines[0]
    assert len(lines) == 14 and lines[-2].startswith("step 12/12, loss ")
    assert "12 steps done, loss " in lines[-1] and "12 steps took " in lines[-1]


def test_the_pace_is_that_of_the_last_minute_and_a_loss_is_a_mean(tmp_path, capsys, monkeypatch):
    """100 steps of a second, then 40 of four; the mean since the start would say 1.86 s at the end."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now, time=lambda: clock.now)
    monkeypatch.setattr("flx.training.log.time", clock)
    run, losses = Run(tmp_path / "said"), np.random.default_rng(0).random(140, np.float32)
    log = Log(run, replace(config, steps=140, log_every=1000), 0, Checkpoints(run.checkpoints))
    for step, loss in enumerate(losses, start=1):
        clock.now += 1 if step <= 100 else 4
        log.add(step, {"loss": jnp.float32(loss)})
    log.finish()
    log.close()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"step 30/140, loss {losses[:30].mean():.4g}, 1 s a step, 01:50 left"
    assert lines[1] == f"step 60/140, loss {losses[30:60].mean():.4g}, 1 s a step, 01:20 left"
    assert lines[-2] == f"step 137/140, loss {losses[129:137].mean():.4g}, 4 s a step, 00:12 left"
    ending = f"140 steps done, loss {losses[124:].mean():.4g} over the last 16; 140 steps took 04:20"
    assert lines[-1] == f"{run.folder}: {ending}"


def test_tensorboard_reads_each_row_and_hides_what_a_kill_left(tmp_path):
    run = Run(tmp_path / "events")
    train(run, replace(config, steps=5), INIT, loss_fn, batches)
    train(run, config, INIT, loss_fn, batches)
    events = [event for path in sorted(run.events.iterdir()) for event in events_of(path)]
    losses = {event.step: v.simple_value for event in events for v in event.summary.value if v.tag == "loss"}
    assert sorted(losses)[-1] == 12 and all(0 < loss < 5 for loss in losses.values())
    starts = [event.step for event in events if event.session_log.status == SessionLog.START]
    assert starts[-1] == 6


def events_of(path: Path) -> Iterator[Event]:
    """The records of a file: length, its checksum, content, its checksum."""
    content = path.read_bytes()
    while content:
        length = int.from_bytes(content[:8], "little")
        yield Event.FromString(content[12 : 12 + length])
        content = content[16 + length :]


def test_damaged_rows_of_the_metrics_are_left_out_with_a_word(tmp_path, capsys):
    metrics = tmp_path / "metrics.csv"
    metrics.write_bytes(b"step,loss\n5,1.0\n\xb10,0.5\n15,0.4\n20,0.3\n25,0.")
    assert _drop_rows_after(metrics, 15) == ["step", "loss"]
    assert metrics.read_bytes() == b"step,loss\n5,1.0\n15,0.4\n"
    assert capsys.readouterr().err == f"{metrics} has 1 damaged rows; they are left out\n"
