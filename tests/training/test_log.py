"""Law of progress: without a terminal it is told in lines."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from helpers.regression import INIT, batches, config, loss_fn
from tensorboardX.proto.event_pb2 import Event, SessionLog

from flx.training.loop import train
from flx.training.run import Run


def test_without_a_terminal_progress_is_told_in_lines(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("flx.training.log._SILENCE", 0.0)
    train(Run(tmp_path / "lines"), config, INIT, loss_fn, batches)
    lines = capsys.readouterr().err.splitlines()
    assert "compiled the train step in" in lines[0]
    assert len(lines) == 13 and lines[-1].startswith("step 12/12, loss ")


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
