"""What a training reports as it goes: metrics.csv, TensorBoard's events and the progress bar."""

import csv
import math
import sys
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

import jax
from jax import Array
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.summary import scalar
from tqdm import tqdm

from flx.config import Train
from flx.files import naming_a_full_disk, write_atomically
from flx.training.checkpoint import Checkpoints
from flx.training.run import Run

_SILENCE = 30.0  # most seconds without a message where there is no terminal for a progress bar
_MINUTE = 60.0  # seconds over which pace and loss are taken: one loss is that of one random t


class Log:
    """Writes the reports, and stops a training whose numbers are not finite.

    A row of metrics.csv is the mean over the steps since the row before, and so is the loss of a line on
    stderr. The pace, and the loss of the progress bar, are those of the last minute.
    """

    def __init__(self, run: Run, config: Train, done: int, checkpoints: Checkpoints):
        self._run, self._config, self._first, self._checkpoints = run, config, done, checkpoints
        self._columns = _drop_rows_after(run.metrics, done)
        self._rows: list[dict[str, float]] = []  # the steps since the last row on disk
        self._step = done
        run.events.mkdir(parents=True, exist_ok=True)
        # Not SummaryWriter, whose thread and queue end in tracebacks on a full disk.
        self._events = EventsWriter(str(run.events / "events"))
        self._events.write_event(Event(step=done + 1, file_version="brain.Event:2"))
        # Hides what a killed training wrote of later steps.
        self._events.write_event(Event(step=done + 1, session_log=SessionLog(status=SessionLog.START)))
        quiet = not sys.stderr.isatty()
        self._bar = tqdm(total=config.steps, initial=done, unit="step", dynamic_ncols=True, disable=quiet)
        self._began = self._row_began = self._spoke = time.monotonic()
        self._recent = deque([(self._began, math.nan)])  # when steps ended, and their losses
        self._unsaid: list[float] = []  # losses since the last line

    def close(self) -> None:
        self._bar.close()
        with naming_a_full_disk(self._run.events):
            self._events.close()

    def add(self, step: int, scalars: dict[str, Array]) -> None:
        """Take the scalars of a step, waiting for it; raise FloatingPointError where one is not finite."""
        values = finite(self._run, self._config, self._checkpoints, step, scalars)
        self._step = step
        self._rows.append(values)
        self._show(values["loss"])
        if step % self._config.log_every == 0:
            self.write()

    def write(self) -> None:
        """End a row: the means over the steps since the last one."""
        if not self._rows:
            return
        now = time.monotonic()
        means = {name: sum(row[name] for row in self._rows) / len(self._rows) for name in self._rows[0]}
        means["seconds"] = (now - self._row_began) / len(self._rows)  # per step, with the wait for batches
        with naming_a_full_disk(self._run.events):
            for name, mean in means.items():
                event = Event(wall_time=time.time(), step=self._step, summary=scalar(name, mean))
                self._events.write_event(event)
            self._events.flush()
        path = self._run.metrics
        with naming_a_full_disk(path), open(path, "a", newline="") as file:
            columns = self._columns or ["step", *means]
            rows = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
            if not self._columns:
                rows.writeheader()
            rows.writerow({"step": self._step} | {name: f"{mean:.7g}" for name, mean in means.items()})
        self._columns, self._rows, self._row_began = columns, [], now

    def finish(self) -> None:
        """Say how a training ended."""
        losses = [loss for _, loss in self._recent if not math.isnan(loss)]
        took, count = tqdm.format_interval(time.monotonic() - self._began), self._step - self._first
        say(
            f"{self._run.folder}: {self._step:,} steps done, loss {_mean(losses):.4g} over the last "
            f"{len(losses):,}; {count:,} steps took {took}"
        )

    def _show(self, loss: float) -> None:
        now = time.monotonic()
        self._recent.append((now, loss))
        while len(self._recent) > 2 and self._recent[1][0] <= now - _MINUTE:
            self._recent.popleft()
        pace = (now - self._recent[0][0]) / (len(self._recent) - 1)
        left = tqdm.format_interval(pace * (self._config.steps - self._step))
        if not self._bar.disable:
            mean = _mean([loss for _, loss in self._recent if not math.isnan(loss)])
            self._bar.set_postfix_str(f"loss {mean:.4g}", refresh=False)
            self._bar.update()
            return
        self._unsaid.append(loss)
        if now - self._spoke >= _SILENCE:
            mean, self._unsaid, self._spoke = _mean(self._unsaid), [], now
            say(f"step {self._step}/{self._config.steps}, loss {mean:.4g}, {pace:.3g} s a step, {left} left")


class Silent:
    """The log of a process that does not write: it only stops a training whose numbers are not finite."""

    def __init__(self, run: Run, config: Train, checkpoints: Checkpoints):
        self._parts = run, config, checkpoints

    def add(self, step: int, scalars: dict[str, Array]) -> None:
        finite(*self._parts, step, scalars)

    def write(self) -> None: ...

    def finish(self) -> None: ...

    def close(self) -> None: ...


def finite(
    run: Run, config: Train, checkpoints: Checkpoints, step: int, scalars: dict[str, Array]
) -> dict[str, float]:
    """The scalars of a step, waiting for it, the loss first; FloatingPointError where one is not finite."""
    scalars = jax.device_get(scalars)
    values = {name: float(scalars[name]) for name in ("loss", *scalars)}
    if wrong := [f"{name} = {value}" for name, value in values.items() if not math.isfinite(value)]:
        latest = checkpoints.latest_step
        saved = "there is no checkpoint yet" if latest is None else f"the last checkpoint is step {latest}"
        raise FloatingPointError(
            f"{run.folder}: step {step} gave {', '.join(wrong)}; {saved}; lower train.learning_rate "
            f"({config.learning_rate:g}) or {'lower train.clip' if config.clip else 'set train.clip to 1'}, "
            "under another --name"
        )
    return values


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _drop_rows_after(metrics: Path, done: int) -> list[str]:
    """Keep the rows of a metrics.csv up to step `done`, as far as they are whole; return its columns.

    Rows without a step, which only damage makes, are left out with a word.
    """
    if not metrics.exists():
        return []
    text = metrics.read_text(errors="replace")
    lines = [line for line in text.splitlines(keepends=True) if line.endswith("\n")]
    rows = [line for line in lines[1:] if line.split(",")[0].isdecimal()]
    if len(rows) < len(lines[1:]):
        say(f"{metrics} has {len(lines) - 1 - len(rows)} damaged rows; they are left out")
    valid = lines[:1] + [line for line in rows if int(line.split(",")[0]) <= done]
    write_atomically(metrics, "".join(valid).encode())
    return valid[0].strip().split(",") if valid else []


def say(message: str) -> None:
    tqdm.write(message, file=sys.stderr)  # above a progress bar, not through it
