"""Laws of run folders: reopened for the same experiment, refused to another, whole at any moment."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flx.config import FLDM, FLVAE, FLDMExperiment, FLVAEExperiment, Surface, Train
from flx.files import write_atomically
from flx.training.run import load_config, only_trainer, open_run

finite = st.floats(allow_nan=False, allow_infinity=False)
positive = st.floats(0, allow_nan=False, allow_infinity=False)
trains = st.builds(Train, steps=st.integers(1), learning_rate=positive, clip=positive)
experiments = st.one_of(
    st.builds(FLVAEExperiment, model=st.builds(FLVAE), kl_weight=finite, train=trains, name=st.just("x")),
    st.builds(
        FLDMExperiment,
        name=st.just("x"),
        model=st.builds(FLDM, blocks=st.none() | st.tuples(*3 * [st.integers(1, 9)])),
        surface=st.builds(Surface, path=st.text(), texture=st.none() | st.text()),
        train=trains,
        weights=st.none() | st.text(),
    ),
)
demo = FLDMExperiment(name="demo", model=FLDM(blocks=(1, 1, 2)))


def fingerprint_of(folder: Path) -> str:
    """What the run says it was made from."""
    return json.loads((folder / "config.json").read_bytes())["fingerprint"]


@given(experiments)
def test_a_config_survives_json(tmp_path_factory, experiment):
    run = open_run(tmp_path_factory.mktemp("runs"), experiment, "ab12")
    read = load_config(run.folder)
    assert type(read) is type(experiment) and read == experiment
    assert repr(read) == repr(experiment)  # 1 == 1.0 and -0.0 == 0.0, but they are not the same config
    assert fingerprint_of(run.folder) == "ab12"


def test_the_same_experiment_reopens_its_run(tmp_path):
    run = open_run(tmp_path, demo, "ab12")
    write_atomically(run.metrics, b"step,loss\n")
    assert open_run(tmp_path, demo, "ab12") == run
    assert run.folder == tmp_path / "demo" and run.metrics.read_bytes() == b"step,loss\n"


def test_another_asset_is_refused(tmp_path):
    open_run(tmp_path, demo, "ab12")
    with pytest.raises(ValueError, match=r"another asset .*ab12, not cd34.*--name") as error:
        open_run(tmp_path, demo, "cd34")
    assert "\n" not in str(error.value) and "delete" not in str(error.value)
    assert fingerprint_of(tmp_path / "demo") == "ab12"


@pytest.mark.parametrize(
    "change, told",
    [
        (dict(model=FLDM(blocks=(1, 1, 2), channels=64)), "model.channels = 96, not 64"),
        (dict(model=FLDM(blocks=(1, 1, 1))), r"model.blocks = \[1, 1, 2\], not \[1, 1, 1\]"),
        (dict(surface=Surface(seed=1)), "surface.seed = 0, not 1"),
        (dict(train=Train(seed=3, clip=2.0)), "train.clip = 0.0, not 2.0, train.seed = 0, not 3"),
        (dict(surface=Surface(copies=499)), "surface.copies = 500, not 499"),
        (dict(surface=Surface(path="b.glb")), "surface.path = , not b.glb"),
        (dict(surface=Surface(texture="b.png")), "surface.texture = None, not b.png"),
    ],
)
def test_another_experiment_is_refused_and_told_what_differs(tmp_path, change, told):
    open_run(tmp_path, demo, "ab12")
    before = (tmp_path / "demo/config.json").read_bytes()
    with pytest.raises(ValueError, match=told) as error:
        open_run(tmp_path, dataclasses.replace(demo, **change), "ab12")
    assert "--name" in str(error.value) and "\n" not in str(error.value)
    assert (tmp_path / "demo/config.json").read_bytes() == before


def test_another_kind_of_experiment_is_refused(tmp_path):
    open_run(tmp_path, demo, "ab12")
    with pytest.raises(ValueError, match="FLDMExperiment, not an FLVAEExperiment"):
        open_run(tmp_path, FLVAEExperiment(name="demo"), "ab12")


def test_length_and_rhythm_may_change_and_the_config_says_the_latest(tmp_path, capsys):
    open_run(tmp_path, demo, "ab12")
    longer = dataclasses.replace(demo, train=Train(steps=7, log_every=1, checkpoint_every=2))
    open_run(tmp_path, longer, "ab12")
    assert load_config(tmp_path / "demo") == longer
    assert "train.steps 300000 → 7; its cosine schedule" in capsys.readouterr().err


def test_harmless_changes_are_taken_and_said_where_they_count(tmp_path, capsys):
    bowl = Surface(path="a/bowl.glb", texture="a/red.png", copies=2)
    first = dataclasses.replace(demo, surface=bowl, weights="w.safetensors")
    open_run(tmp_path, first, "ab12")
    moved = dataclasses.replace(bowl, path="/b/bowl.glb", texture="red.png", up="z", copies=4)
    second = dataclasses.replace(first, surface=moved, weights="/b/w2.safetensors", train=Train(batch=32))
    assert load_config(open_run(tmp_path, second, "ab12").folder) == second
    told = capsys.readouterr().err.splitlines()
    assert [line.split(": ")[1].split(" ")[0] for line in told] == ["surface.copies", "train.batch"]
    with pytest.raises(ValueError, match=r"surface.path = /b/bowl.glb, not a/bowl.glb.*another asset"):
        open_run(
            tmp_path, dataclasses.replace(second, surface=dataclasses.replace(moved, path="a/bowl.glb")), "cd"
        )


def test_a_record_without_later_fields_means_what_was(tmp_path):
    path = open_run(tmp_path, demo, "ab12").config
    record = json.loads(path.read_bytes())
    for name in ("draws", "emphasis", "label_dropout", "directions", "direction_dropout"):
        del record["config"]["model"][name]
    for name in ("labels", "direction"):
        del record["config"]["surface"][name]
    path.write_text(json.dumps(record))
    assert load_config(path.parent) == demo
    other = dataclasses.replace(demo, model=dataclasses.replace(demo.model, draws="lognormal"))
    with pytest.raises(ValueError, match=r"model.draws = uniform, not lognormal"):
        open_run(tmp_path, other, "ab12")
    assert load_config(open_run(tmp_path, demo, "ab12").folder) == demo


def test_a_renamed_folder_is_the_same_run(tmp_path):
    write_atomically(open_run(tmp_path, demo, "ab12").metrics, b"step,loss\n")
    (tmp_path / "demo").rename(tmp_path / "kept")
    run = open_run(tmp_path, dataclasses.replace(demo, name="kept"), "ab12")
    assert run.folder == tmp_path / "kept" and run.metrics.read_bytes() == b"step,loss\n"
    assert load_config(run.folder) == dataclasses.replace(demo, name="kept")
    assert list(tmp_path.iterdir()) == [run.folder]  # none was made under the old name
    with pytest.raises(ValueError, match=r"another asset.*--name"):
        open_run(tmp_path, dataclasses.replace(demo, name="kept"), "cd34")


@pytest.mark.parametrize("name", ["", "..", ".", "a/b", "/tmp/x"])
def test_a_run_stays_in_its_root(tmp_path, name):
    with pytest.raises(ValueError, match="is not a folder name"):
        open_run(tmp_path / "runs", dataclasses.replace(demo, name=name), "ab12")
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_is_refused(tmp_path):
    write_atomically(tmp_path / "demo/thesis.tex", b"")
    with pytest.raises(ValueError, match=r"no config.json but holds thesis.tex"):
        open_run(tmp_path, demo, "ab12")


def test_torn_temporary_files_are_ignored(tmp_path):
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo/.99.config.json").write_text('{"kind": "FLDM')
    assert load_config(open_run(tmp_path, demo, "ab12").folder) == demo


@pytest.mark.parametrize(
    "place, value, told",
    [
        (("config", "train", "steps"), "many", "config.train.steps is 'many', not a int"),
        (("config", "train", "steps"), True, "config.train.steps is True"),
        (("config", "model", "filter"), "box", "config.model.filter is 'box'"),
        (("config", "model", "blocks"), [1, 2], r"config.model.blocks is \[1, 2\]"),
        (("config", "speed"), 3, "config has an unknown field 'speed'"),
        (("kind",), "subprocess.Popen", "does not record a run"),
        (("config",), None, "does not record a run"),
        (("config", "model"), None, "config.model is None"),
        (("config", "surface"), 5, "config.surface is 5"),
    ],
)
def test_a_wrong_config_file_is_refused_by_place(tmp_path, place, value, told):
    path = open_run(tmp_path, demo, "ab12").config
    record = json.loads(path.read_bytes())
    *way, last = place
    inside = record
    for name in way:
        inside = inside[name]
    inside[last] = value
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=told) as error:
        load_config(path.parent)
    assert "\n" not in str(error.value)


def test_a_missing_field_a_torn_file_and_no_file_are_refused(tmp_path):
    path = open_run(tmp_path, demo, "ab12").config
    record = json.loads(path.read_bytes())
    del record["config"]["train"]["clip"]
    path.write_text(json.dumps(record))
    with pytest.raises(ValueError, match=r"config.train has no field 'clip'"):
        load_config(path.parent)
    path.write_text('{"kind')
    with pytest.raises(ValueError, match="does not record a run"):
        load_config(path.parent)
    with pytest.raises(ValueError, match="is not a run"):
        load_config(tmp_path)


def test_a_second_trainer_is_refused_and_a_killed_one_is_not_in_the_way(tmp_path):
    run = open_run(tmp_path, demo, "ab12")
    hold = (
        "import sys, time; from pathlib import Path; from flx.training.run import Run, only_trainer\n"
        "with only_trainer(Run(Path(sys.argv[1]))): print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(run.folder)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "held\n"
        with pytest.raises(ValueError, match=rf"trained by process {other.pid};.*--name"), only_trainer(run):
            pass
        before, longer = run.config.read_bytes(), dataclasses.replace(demo.train, steps=demo.train.steps + 1)
        with pytest.raises(ValueError, match="is being trained"):
            open_run(tmp_path, dataclasses.replace(demo, train=longer), "ab12")
        assert run.config.read_bytes() == before
        other.kill()
    with only_trainer(run), pytest.raises(ValueError, match="is being trained"), only_trainer(run):
        pass


@pytest.mark.parametrize("place", [".lock", "checkpoints", "asset/files", "events/x", "samples", "loop"])
def test_a_link_in_a_run_is_refused_before_it_is_followed(tmp_path, place):
    """A linked lock would be emptied; in a linked folder of checkpoints the older ones would be deleted."""
    run = open_run(tmp_path, demo, "ab12")
    (victim := tmp_path / "victim").mkdir()
    (victim / "1.safetensors").write_text("mine")
    link = run.folder / place
    link.parent.mkdir(parents=True, exist_ok=True)
    target = {".lock": victim / "1.safetensors", "loop": run.folder}.get(place, victim)
    link.unlink(missing_ok=True)
    link.symlink_to(target)
    for reopens in (lambda: open_run(tmp_path, demo, "ab12"), lambda: load_config(run.folder)):
        with pytest.raises(ValueError, match=f"{place} is a link; put") as refusal:
            reopens()
        assert "\n" not in str(refusal.value)
    assert (victim / "1.safetensors").read_text() == "mine" and len(list(victim.iterdir())) == 1


def test_a_run_may_lie_behind_a_link(tmp_path):
    open_run(tmp_path / "disk", demo, "ab12")
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(tmp_path / "disk" / "demo")
    assert load_config(open_run(tmp_path / "runs", demo, "ab12").folder) == demo
