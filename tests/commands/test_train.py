"""Laws of `flx train`: what cannot be trained is refused before anything is made, and what it tells works."""

from pathlib import Path

import pytest

from flx.commands import train
from flx.commands.train import learn
from flx.config import FLVAE, FLDMExperiment, FLVAEExperiment
from flx.launch import parse
from flx.training.run import Run


def test_a_model_that_cannot_be_made_leaves_no_run_behind(tmp_path):
    with pytest.raises(ValueError, match="invariants"):
        learn(FLVAEExperiment(model=FLVAE(invariants=2)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_the_next_command_is_told_as_a_shell_takes_it(monkeypatch, capsys):
    monkeypatch.setattr(train, "learn", lambda experiment, **_: Run(Path("runs/my vase")))
    train._run(FLDMExperiment(), None, None, None)
    assert "; flx sample 'runs/my vase' makes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["bowl.glb"], "bowl"),
        (["experiments/demo.py"], "demo"),
        (["experiments/demo.py", "--surface.path", "x/bowl.glb"], "bowl"),
        (["experiments/demo.py", "--surface.path=x/bowl.glb", "--name=demo"], "demo"),
        (["experiments/bowl.py", "--surface.path", "x/akita_black_bowl.obj"], "bowl"),
        (["experiments/bowl.py", "--surface.path", ""], "vase"),
        (["experiments/flvae.py"], "flvae"),
    ],
)
def test_a_run_is_named_after_the_mesh_that_it_learns(monkeypatch, words, name):
    learnt = []
    monkeypatch.setattr(train, "_run", lambda experiment, *_: learnt.append(experiment))
    parse(["train", *words])()
    assert [experiment.name for experiment in learnt] == [name]
