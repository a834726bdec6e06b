"""Law of progress: without a terminal it is told in lines."""

from helpers.regression import INIT, batches, config, loss_fn

from flx.training.loop import train
from flx.training.run import Run


def test_without_a_terminal_progress_is_told_in_lines(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("flx.training.log._SILENCE", 0.0)
    train(Run(tmp_path / "lines"), config, INIT, loss_fn, batches)
    lines = capsys.readouterr().err.splitlines()
    assert "compiled the train step in" in lines[0]
    assert len(lines) == 13 and lines[-1].startswith("step 12/12, loss ")
