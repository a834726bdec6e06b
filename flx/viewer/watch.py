"""The page of a training: its curves, and a small preview of what it makes so far, live.

The training itself does nothing for it: its metrics are read from its file, and previews are made of the
generator that it saves at each checkpoint, by a process that yields to it.
"""

import csv
import io
import json
import math
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from flx.files import write_atomically
from flx.machine import yield_to_others
from flx.pipeline.workers import in_processes
from flx.viewer.page import html
from flx.viewer.server import Answer, Answers

POINTS = 2000  # most rows of the metrics that a page draws
STEPS, TEXTURE, VIEW = 10, 512, 256  # of a preview: evaluations; pixels of the atlas, and of a view
PAUSE = 5.0  # seconds between two looks at the generator


class Watched:
    """What the page asks for: the metrics of a run, and its previews."""

    most = 100  # bytes that the page may send

    def __init__(
        self, name: str, steps: int, metrics: Path, generator: Path, previews: Path, up: str
    ) -> None:
        """`steps`: of the whole training. `previews` is a folder; it need not be there."""
        self.name, self.steps, self.metrics, self.up = name, steps, metrics, up
        self.generator, self.previews = generator, previews
        self.trouble = ""  # why there is no newer preview

    def answers(self) -> Answers:
        """For `flx.viewer.server`."""
        return {
            ("GET", ""): lambda _: ("text/html; charset=utf-8", self._page()),
            ("GET", "data"): lambda _: ("application/json", json.dumps(self.data()).encode()),
            ("POST", "preview"): self._preview,
        }

    def data(self) -> dict[str, Any]:
        """Curves by name, each with its steps, and the steps of which there are previews."""
        return {
            "steps": self.steps,
            "curves": curves(self.metrics),
            "previews": self.steps_shown(),
            "trouble": self.trouble,
        }

    def steps_shown(self) -> list[int]:
        """The steps of which there are previews."""
        names = (path.stem for path in self.previews.glob("*.jpg"))
        return sorted(int(name) for name in names if name.isascii() and name.isdecimal())

    def make_previews(self, finished: threading.Event) -> None:
        """A preview of each generator that is saved, until `finished`; one at a time, the newest first."""
        seen = -1
        while not finished.wait(PAUSE if seen >= 0 else 0.1):
            if not self.generator.exists() or (stamp := self.generator.stat().st_mtime_ns) == seen:
                seen = max(seen, 0)
                continue
            task = (str(self.generator), str(self.previews), self.up)
            try:
                list(in_processes(preview, (), [task], 1))
                self.trouble = ""
            except (ValueError, OSError) as fault:  # the generator is of another version, the disk is full
                self.trouble = " ".join(str(fault).split())
            seen = stamp

    def _preview(self, body: bytes) -> Answer:
        step = body.decode("ascii", "replace")
        if not step.isdecimal() or int(step) not in self.steps_shown():
            raise ValueError(f"there is no preview of step {step[:20]!r}")
        return "image/jpeg", (self.previews / f"{int(step)}.jpg").read_bytes()

    def _page(self) -> bytes:
        libraries, styles = ("uplot.min.js",), ("page.css", "uplot.min.css", "watch.css")
        return html("watch.html", styles, libraries, ("watch.js",), title=self.name, data={}, served=True)


def curves(metrics: Path) -> dict[str, list[float | None]]:
    """The columns of a metrics.csv by name, `step` first, as far as its rows are whole.

    Of many rows, some are left out evenly, never the last. What is not finite is None.
    """
    if not metrics.exists():
        return {}
    text = metrics.read_text()
    rows = list(csv.DictReader(io.StringIO(text[: text.rfind("\n") + 1])))
    if not rows:
        return {}
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).astype(int))
    return {name: [_number(rows[n][name]) for n in chosen] for name in rows[0]}


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None


def preview(generator: str, folder: str, up: str) -> None:
    """Write FOLDER/STEP.jpg: the input and a sample of the network alone, always of the same noise.

    For a process of its own, which yields to all others.
    """
    yield_to_others()
    os.environ["JAX_PLATFORMS"] = "cpu"  # a training may fill its accelerator
    from flx.controls import Controls
    from flx.pipeline.canvas import side_by_side
    from flx.pipeline.generator import read_generator
    from flx.pipeline.variations import generate
    from flx.viewer.pictures import jpeg

    learnt = read_generator(Path(generator))
    alone = Controls(invention=1.0)
    painting = next(generate(learnt, 1, steps=STEPS, texture_size=TEXTURE, controls=alone))
    sheet: UInt8[Any, "_ _ 3"] = side_by_side(learnt.asset, [painting], [f"step {learnt.step:,}"], up, VIEW)
    Path(folder).mkdir(exist_ok=True)
    write_atomically(Path(folder) / f"{learnt.step}.jpg", jpeg(sheet, 88))
