"""Laws of what `flx evaluate` judges: the samples that it is told to make, and the record says so."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.files import colored_ball

from flx.assets.asset import own_painting
from flx.assets.read import read_asset
from flx.commands.evaluate import Evaluate
from flx.config import Surface
from flx.controls import INVENTION


@pytest.fixture
def made(tmp_path, monkeypatch) -> list:
    """What was made and judged; nothing is, but for the record."""
    asset, calls = read_asset(colored_ball(tmp_path)), []
    home = SimpleNamespace(triangulation=SimpleNamespace(vertices=[0] * 177))
    experiment = SimpleNamespace(surface=Surface())
    learnt = {"params": {"w": np.ones(2)}, "step": 7}
    run = SimpleNamespace(asset=asset, home=home, experiment=experiment, **learnt)
    run.labels = run.labelled = run.direction = run.intact = None

    def generate(generator, count, *_, controls, **__):
        how = controls.height or "generate", controls.invented
        calls.append(how if controls.guidance else "without labels")
        return iter([own_painting(generator.asset)] * count)

    def patchworks(vertices: int, count: int, *_):
        calls.append(("patchworks", vertices))
        return iter([own_painting(asset)] * count)

    def judge_samples(_, samples, others, seed):
        calls.append(("judged", [*samples]))
        return {name: {} for name in (*samples, "samples", "input")}

    def labels_followed(mesh, own, wanted, textures, seed):
        assert (own, wanted) == ("own labels", "own labels")
        return {name: 0.2 if "without" in name else 0.8 for name in ("input", *textures)}

    monkeypatch.setattr("flx.training.load.load_generator", lambda _: run)
    monkeypatch.setattr("flx.pipeline.variations.generate", generate)
    monkeypatch.setattr("flx.pipeline.variations.reconstruct", lambda *_: own_painting(asset))
    monkeypatch.setattr("flx.pipeline.instant.patch_generator", lambda _, patches, *rest: patches.vertices)
    monkeypatch.setattr("flx.pipeline.instant.patchworks", patchworks)
    monkeypatch.setattr("flx.assets.vase.vase_asset", lambda: asset)
    monkeypatch.setattr("flx.evaluation.controls.controls", lambda *_: {})
    monkeypatch.setattr("flx.evaluation.samples.judge_samples", judge_samples)
    monkeypatch.setattr("flx.evaluation.labels.labels_followed", labels_followed)
    monkeypatch.setattr("flx.pipeline.layout.run_guides", lambda *_: None)
    monkeypatch.setattr("flx.evaluation.report.page", lambda *_: "")
    (tmp_path / "run").mkdir()
    return calls


def test_a_run_with_labels_is_judged_by_them_with_and_without(tmp_path, monkeypatch, made):
    """The same number of samples at guidance 0, which are judged by their labels alone."""
    monkeypatch.setattr("flx.pipeline.layout.asked_labels", lambda *_: ("own labels", "own labels"))
    Evaluate(source=tmp_path / "run", count=2, out=tmp_path / "out")()
    assert made == [("generate", INVENTION), "without labels", ("judged", ["sample 0", "sample 1"])]
    rows = json.loads((tmp_path / "out" / "evaluation.json").read_bytes())["rows"]
    told = {name: {"labels_1": 0.8} for name in ("sample 0", "sample 1", "samples", "input")}
    assert rows == {**told, "without labels": {"labels_1": 0.2}}


def test_labels_and_height_go_with_what_is_made(tmp_path):
    path = tmp_path / "zones.png"
    with pytest.raises(
        ValueError, match=r"height z is for samples that flx makes; leave out --height or --s"
    ):
        Evaluate(source=tmp_path, samples=(tmp_path / "a.glb",), height="z")()
    with pytest.raises(ValueError, match=r"zones.png is for samples that flx makes; leave out"):
        Evaluate(source=tmp_path, samples=(tmp_path / "a.glb",), labels=path)()
    with pytest.raises(ValueError, match=r"input labels .*zones.png go with --instant; add that"):
        Evaluate(source=tmp_path, input_labels=path)()


@pytest.mark.parametrize(
    ("options", "call", "said"),
    [
        ({"source": "run"}, ("generate", INVENTION), (False, INVENTION)),
        ({"source": "run", "invention": 1.0}, ("generate", 1.0), (False, 1.0)),
        ({"source": "run", "height": "z"}, ("z", INVENTION), (False, INVENTION)),
        ({"source": "run", "instant": True}, ("patchworks", 177), (True, None)),
        ({"source": "ball.glb", "instant": True}, ("patchworks", 5000), (True, None)),
        ({"instant": True}, ("patchworks", 5000), (True, None)),
    ],
)
def test_samples_are_made_as_they_are_asked_for(tmp_path, monkeypatch, made, options, call, said):
    monkeypatch.chdir(tmp_path)
    file = colored_ball(tmp_path)
    if "source" in options:
        options = options | {"source": Path("run") if options["source"] == "run" else file}
    Evaluate(**options, count=2, out=tmp_path / "out")()
    assert made == [call, ("judged", ["sample 0", "sample 1"])]
    record = json.loads((tmp_path / "out" / "evaluation.json").read_bytes())
    assert (record["instant"], record["invention"]) == said


def test_no_evaluation_replaces_another(tmp_path, monkeypatch, made):
    monkeypatch.chdir(tmp_path)
    run, ball, seen = Path("run"), colored_ball(tmp_path), []
    other = tmp_path / "other.ply"
    other.write_bytes(ball.read_bytes())
    calls = (
        *({"source": run, **more} for more in ({}, {"seed": 1}, {"count": 2}, {"invention": 1.0})),
        *({"source": run, **more} for more in ({"instant": True}, {"samples": (other,)})),
        {"source": ball, "samples": (other,)},
    )
    for options in calls + calls:
        Evaluate(**options)()
        seen.append(sorted(path.relative_to(tmp_path) for path in tmp_path.glob("**/evaluation.html")))
    assert [len(pages) for pages in seen] == [1, 2, 3, 4, 5, 6, 7] + [7] * 7
    names = {str(page.parent) for page in seen[-1]}
    assert {"run/evaluation", "run/evaluation-seed-1", "run/evaluation-count-2"} < names
    assert {"run/evaluation-instant", "run/evaluation-invention-1-0"} < names
    with pytest.raises(ValueError, match=r"holds the files of another call \(seed = 0, not 3\)"):
        Evaluate(source=run, seed=3, out=tmp_path / "run/evaluation")()
    ball.write_bytes(ball.read_bytes().replace(b"end_header", b"comment painted over\nend_header"))
    other.write_bytes(ball.read_bytes())
    Evaluate(source=run, samples=(other,))()
    assert len([*tmp_path.glob("**/evaluation.html")]) == 8


def test_an_evaluation_by_labels_that_were_painted_over_is_another(tmp_path, monkeypatch, made):
    monkeypatch.setattr("flx.pipeline.layout.asked_labels", lambda *_: None)
    monkeypatch.chdir(tmp_path)
    for content in (b"one", b"two", b"two"):
        (tmp_path / "zones.png").write_bytes(content)
        Evaluate(source=Path("run"), labels=Path("zones.png"))()
    assert len([*tmp_path.glob("**/evaluation.html")]) == 2


def test_labels_that_are_not_there_are_named_before_anything_is_made(tmp_path, monkeypatch, made):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"labels none\.png do not exist"):
        Evaluate(source=Path("run"), labels=Path("none.png"))()
    assert not made


def test_samples_without_a_network_have_no_other_source(tmp_path):
    for more in ({"samples": (tmp_path / "a.glb",)}, {"invention": 0.5}):
        with pytest.raises(ValueError) as refusal:
            Evaluate(source=tmp_path, instant=True, **more)()
        remedy = "leave out --samples and --invention"
        assert str(refusal.value) == f"--instant makes its samples without a network; {remedy}"
