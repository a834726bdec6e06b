"""`flx watch`: it serves the page of a run, and says what is no run."""

import http.client
import json
import threading
import time
from dataclasses import asdict

import pytest

from flx.commands.watch import Watch, serve
from flx.config import FLDMExperiment, FLVAEExperiment
from flx.launch import main


def recorded(folder, experiment):
    folder.mkdir()
    record = {"flx": "0", "kind": type(experiment).__name__, "fingerprint": "0"}
    (folder / "config.json").write_text(json.dumps(record | {"config": asdict(experiment)}))
    return folder


def test_the_page_of_a_run_is_served_until_it_ends(tmp_path, capfd):
    run, finished = recorded(tmp_path / "bowl", FLDMExperiment(name="bowl")), threading.Event()
    (run / "metrics.csv").write_text("step,loss\n50,0.9\n")
    options = Watch(run, browser=False)
    running = threading.Thread(target=serve, args=(options, finished), daemon=True)
    running.start()
    said = ""
    while "/\n" not in said:
        said += capfd.readouterr().err
        time.sleep(0.02)
    host, path = said.split("http://")[1].split()[0].split("/", 1)

    def ask(name):
        link = http.client.HTTPConnection(host, timeout=30)
        link.request("GET", f"/{path}{name}")
        return link.getresponse().read()

    assert b"uPlot" in ask("") and b"<title>bowl</title>" in ask("")
    assert json.loads(ask("data"))["curves"] == {"step": [50], "loss": [0.9]}
    finished.set()
    running.join(10)
    assert not running.is_alive()
    with pytest.raises(OSError):
        ask("")


@pytest.mark.parametrize(
    ("experiment", "line"), [(None, "is not a run"), (FLVAEExperiment(name="x"), "run of an FL-VAE")]
)
def test_what_is_no_run_of_a_mesh_is_said(tmp_path, capsys, experiment, line):
    folder = recorded(tmp_path / "x", experiment) if experiment else tmp_path
    assert main(["watch", str(folder), "--no-browser"]) == 2
    assert line in capsys.readouterr().err
