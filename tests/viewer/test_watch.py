"""Laws of `flx watch`: what it shows of a run is what the run has, also half a row and half a run."""

import json
import threading
import time
from io import BytesIO

import pytest
from helpers.generators import ball_generator
from PIL import Image

from flx.pipeline.generator import save_generator
from flx.viewer.watch import POINTS, Watched, curves, preview

ROWS = "step,loss,seconds\n50,0.9,0.25\n100,0.8,nan\n150,0."


@pytest.fixture
def run(tmp_path):
    places = tmp_path / "metrics.csv", tmp_path / "generator.safetensors", tmp_path / "previews"
    return Watched("bowl", 200, *places, "y")


def test_a_run_that_has_not_begun_has_no_curves_and_no_previews(run):
    assert run.data() == {"steps": 200, "curves": {}, "previews": [], "trouble": ""}


def test_a_row_that_is_being_written_is_left_out_and_what_is_not_finite_is_a_gap(run):
    run.metrics.write_text(ROWS)
    assert curves(run.metrics) == {"step": [50, 100], "loss": [0.9, 0.8], "seconds": [0.25, None]}
    json.dumps(run.data(), allow_nan=False)
    run.metrics.write_text("step,loss\n")
    assert curves(run.metrics) == {}


def test_of_a_long_training_the_last_row_stays(run):
    run.metrics.write_text("step,loss\n" + "".join(f"{n},{n / 7}\n" for n in range(3 * POINTS)))
    steps = curves(run.metrics)["step"]
    assert len(steps) == POINTS and steps[0] == 0 and steps[-1] == 3 * POINTS - 1


def test_a_preview_is_served_by_its_step_and_no_other_file(run):
    run.previews.mkdir()
    Image.new("RGB", (4, 4), (200, 0, 0)).save(run.previews / "100.jpg")
    for name in ("x.jpg", "100.png", ".5.jpg"):
        (run.previews / name).write_bytes(b"")
    assert run.data()["previews"] == [100]
    ask = run.answers()["POST", "preview"]
    assert ask(b"100") == ("image/jpeg", (run.previews / "100.jpg").read_bytes())
    for body in (b"", b"200", b"x", b"../previews/100", b"\xff", b"1" * 90):
        with pytest.raises(ValueError, match="there is no preview of step"):
            ask(body)


def test_a_new_generator_is_previewed_once_and_a_fault_is_told(run, monkeypatch):
    finished, made = threading.Event(), []

    def in_process(function, _, tasks, __):
        made.append(tasks)
        if len(made) == 2:
            raise ValueError("damaged\nfile")
        yield 0, None

    monkeypatch.setattr("flx.viewer.watch.in_processes", in_process)
    monkeypatch.setattr("flx.viewer.watch.PAUSE", 0.01)
    told = []

    def changes():
        for content in (b"a", b"bb"):
            run.generator.write_bytes(content)
            count = len(made)
            while len(made) == count:
                time.sleep(0.01)
            finished.wait(0.1)
            told.append(run.trouble)
        finished.set()

    threading.Thread(target=changes).start()
    run.make_previews(finished)
    assert [tasks[0][0] for tasks in made] == [str(run.generator)] * 2
    assert told == ["", "damaged file"]


@pytest.mark.slow
def test_a_preview_is_a_picture_of_the_input_and_a_sample(tmp_path, monkeypatch):
    monkeypatch.setattr("flx.viewer.watch.yield_to_others", lambda: None)
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    learnt = ball_generator(tmp_path)
    save_generator(tmp_path / "generator.safetensors", learnt)
    preview(str(tmp_path / "generator.safetensors"), str(tmp_path / "previews"), "y")
    picture = Image.open(BytesIO((tmp_path / "previews" / f"{learnt.step}.jpg").read_bytes()))
    assert picture.width > 2 * 250 and len(set(picture.resize((40, 40)).getdata())) > 50
