"""`flx watch`: the curves and previews of a training, live in a browser."""

import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

if TYPE_CHECKING:
    from flx.viewer.watch import Watched


@dataclass(frozen=True)
class Watch:
    """Watch a training in the browser: its curves, and what it makes so far.

    Example: flx watch runs/bowl        while, or after, `flx train` makes it; Ctrl-C ends the page alone
    """

    run: Positional[Path]  # a run folder
    previews: bool = True  # make a small picture at each checkpoint, in a process that yields to the training
    browser: bool = True  # open the page in the browser; without it, the address is printed alone

    def __call__(self) -> None:
        serve(self, threading.Event())


def serve(options: Watch, finished: threading.Event) -> None:
    """Serve the page until `finished`. Raises ValueError where the folder is not the run of an FLDM."""
    from flx.stopping import keeping
    from flx.viewer.server import open_browser, serving

    page = watched(options.run)
    keeping(lambda: "the page has ended; a training goes on without it")
    with serving(page.answers(), page.most) as server:
        print(
            f"flx: watch {options.run} at {server.url}\nflx: Ctrl-C here ends the page alone", file=sys.stderr
        )
        if options.browser:
            open_browser(server)
        if options.previews:
            page.make_previews(finished)
        finished.wait()


def watched(folder: Path) -> "Watched":
    """What the page shows of a run. Raises ValueError where the folder is not the run of an FLDM."""
    from flx.config import FLDMExperiment
    from flx.training.run import Run, load_config
    from flx.viewer.watch import Watched

    experiment, run = load_config(folder), Run(folder)
    if not isinstance(experiment, FLDMExperiment):
        raise ValueError(f"{folder} is the run of an FL-VAE; watch one of `flx train MESH`")
    places = run.metrics, run.generator, run.previews
    return Watched(experiment.name, experiment.train.steps, *places, experiment.surface.up)
