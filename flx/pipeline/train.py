"""One training loop for both models: Adam or Muon, a cosine schedule, averaged parameters, checkpoints.

Step n (from 0) sees `batches(n)` and the key `fold_in(seed, n)`, whatever happened before it: a run that was
killed and called again takes the steps it would have taken. "Step" in metrics.csv, in messages and in the
names of checkpoints is the number of steps done. The rows of metrics.csv part the steps: a row is the mean
over the steps since the row before, and a checkpoint ends a row.
"""

import contextlib
import csv
import math
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Float32, Int, Int32, UInt32
from tensorboardX import SummaryWriter
from tqdm import tqdm

from flx.config import Train
from flx.mesh.formats.files import write_atomically
from flx.pipeline.checkpoint import Checkpoints
from flx.pipeline.runs import Run, only_trainer

LossFn = Callable[[Any, Any, Array], tuple[Array, dict[str, Array]]]  # parameters, batch, key → loss, metrics
Batches = Callable[[int], Any]  # step → arrays, always the same for a step

MATRICES = ("kernel", "output")  # names of parameters that Muon takes: of a layer, of a filter bank
ADAM_BESIDE_MUON = 0.15  # of Muon's rate, for parameters that are no matrices

_SILENCE = 30.0  # most seconds without a word where there is no terminal for a progress bar


class TrainState(NamedTuple):
    """All that the next step hangs on. `Any` is a pytree of arrays."""

    step: Int32[Any, ""]  # steps done
    params: Any
    ema: Any  # the average that sampling uses; like `params`
    optimizer: Any
    key: UInt32[Any, "2"]  # of the run


def learning_rate(config: Train, step: Int[Any, ""] | int) -> Float32[Array, ""]:
    """Linear warm-up from 0 to `learning_rate`, then a cosine to `final_learning_rate` at the last step."""
    peak, final = config.learning_rate, config.final_learning_rate
    progress = jnp.clip((step - config.warmup) / max(config.steps - 1 - config.warmup, 1), 0, 1)
    cosine = final + (peak - final) * (1 + jnp.cos(jnp.pi * progress)) / 2
    warm = jnp.clip(step / max(config.warmup, 1), 0, 1) if config.warmup else 1.0
    return jnp.asarray(warm * cosine, jnp.float32)


def make_optimizer(config: Train) -> optax.GradientTransformation:
    """Adam or Muon along `learning_rate`, on gradients no longer than `clip` (0: as they are).

    Raises ValueError where the configuration cannot be trained with.
    """
    for name in ("steps", "batch", "learning_rate", "log_every", "checkpoint_every"):
        if getattr(config, name) <= 0:
            raise ValueError(f"train.{name} is {getattr(config, name)}; make it more than 0")
    if not 0 <= config.warmup < config.steps:
        raise ValueError(f"train.warmup is {config.warmup}; keep it from 0 to train.steps ({config.steps})")
    if not 0 <= config.ema < 1:
        raise ValueError(f"train.ema is {config.ema}; keep it at least 0 and below 1")
    optimizer = {"adam": optax.adam, "muon": muon}[config.optimizer](lambda step: learning_rate(config, step))
    return optax.chain(optax.clip_by_global_norm(config.clip), optimizer) if config.clip else optimizer


def muon(rate: optax.Schedule) -> optax.GradientTransformation:
    """Muon (Jordan et al. 2024): updates of dense kernels made orthogonal: all directions learn alike.

    `rate` is the spectral norm of such an update; what is no kernel is left to Adam, at a smaller rate.
    """

    def dimensions(params: Any) -> Any:
        return jax.tree.map_with_path(_kernel_dimensions, params)

    slower = lambda step: ADAM_BESIDE_MUON * rate(step)  # noqa: E731
    return optax.contrib.muon(rate, adam_learning_rate=slower, muon_weight_dimension_numbers=dimensions)


def _kernel_dimensions(path: tuple, leaf: Any) -> optax.contrib.MuonDimensionNumbers | None:
    """Kernels are [..., inputs, outputs]; layers of a scan and (re, im) are matrices of their own."""
    if getattr(path[-1], "key", None) not in MATRICES:
        return None
    return optax.contrib.MuonDimensionNumbers(reduction_axis=leaf.ndim - 2, output_axis=leaf.ndim - 1)


def initial_state(config: Train, init_params: Any) -> TrainState:
    """The state before the first step; each leaf is a copy, because a step takes the buffers of its state."""
    params, ema = jax.tree.map(jnp.array, init_params), jax.tree.map(jnp.array, init_params)
    key = jax.random.key_data(jax.random.key(config.seed))
    return TrainState(jnp.int32(0), params, ema, make_optimizer(config).init(params), key)


def restore(run: Run, config: Train, init_params: Any) -> TrainState:
    """The newest checkpoint of a run, as NumPy arrays; `init_params` may be `jax.ShapeDtypeStruct`s.

    Raises ValueError where the run has no checkpoint, or one of another network.
    """
    template = jax.eval_shape(lambda params: initial_state(config, params), init_params)
    with Checkpoints(run.checkpoints) as checkpoints:
        restored = checkpoints.restore_latest(template)
    if restored is None:
        raise ValueError(f"{run.folder} has no checkpoint yet; train it first with `flx train`")
    return restored[1]


def make_step(
    config: Train, loss_fn: LossFn
) -> Callable[[TrainState, Any], tuple[TrainState, dict[str, Array]]]:
    """One step: `(state, batch) → (next state, scalars)`. Pure; `jit` it.

    The decay of the average is min(ema, (1 + n)/(10 + n)) at step n: it soon forgets the initial parameters.
    """
    optimizer = make_optimizer(config)

    def step(state: TrainState, batch: Any) -> tuple[TrainState, dict[str, Array]]:
        n = state.step
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), n)
        (loss, metrics), gradient = jax.value_and_grad(loss_fn, has_aux=True)(state.params, batch, key)
        updates, moments = optimizer.update(gradient, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        decay = jnp.minimum(config.ema, (1 + n) / (10 + n))
        ema = jax.tree.map(lambda average, p: average + (1 - decay) * (p - average), state.ema, params)
        # The norm is there to be plotted, and because a finite loss may have a gradient that is not.
        scalars = {"loss": loss, "gradient_norm": optax.global_norm(gradient)}
        scalars |= {"learning_rate": learning_rate(config, n), **metrics}
        return TrainState(n + 1, params, ema, moments, state.key), scalars

    return step


def train(run: Run, config: Train, init_params: Any, loss_fn: LossFn, batches: Batches) -> TrainState:
    """Train from the newest checkpoint, or from `init_params`, to `config.steps`; return the state there.

    `loss_fn(params, batch, key) → (loss, scalars by name)` is pure; `batches(step)` is a pytree of fresh
    arrays, of the same shapes at each step, made in a thread of its own. On SIGTERM or SIGINT the state is
    saved and SystemExit(128 + signal) raised. Raises FloatingPointError at the first step with a number that
    is not finite (the checkpoint before it stays), and ValueError where another process trains here.
    """
    with only_trainer(run), Checkpoints(run.checkpoints, writer=True) as checkpoints:
        state = initial_state(config, init_params)
        if restored := checkpoints.restore_latest(state):
            state = jax.device_put(restored[1])
            _say(f"{run.folder}: resumed at step {restored[0]} of {config.steps}")
        done = int(state.step)
        if done >= config.steps:
            return state
        with _Stop() as stop, contextlib.closing(_prefetch(batches, done, config.steps)) as feed:
            batch = next(feed)
            began = time.monotonic()
            step = jax.jit(make_step(config, loss_fn), donate_argnums=0).lower(state, batch).compile()
            _say(f"{run.folder}: compiled the train step in {time.monotonic() - began:.1f} s")
            with _Log(run, config, done, checkpoints) as log:
                under_way = None  # the scalars of the step that the device works on
                while True:
                    state, scalars = step(state, batch)
                    if under_way:
                        log.add(done, under_way)  # waits for the step before: the host runs one step ahead
                    done, under_way = done + 1, scalars
                    last = done == config.steps or stop.signal is not None
                    if last or done % config.checkpoint_every == 0:
                        log.add(done, under_way)  # first: a state that is not finite is never saved
                        log.write()
                        checkpoints.save(done, state)
                        under_way = None
                    if last:
                        break
                    batch = next(feed)
        if stop.signal is not None and done < config.steps:
            checkpoints.wait()
            _say(f"{run.folder}: stopped, saved at step {done}; the same command goes on from there")
            raise SystemExit(128 + stop.signal)
        return state


def _prefetch(batches: Batches, first: int, last: int, depth: int = 2) -> Generator[Any, None, None]:
    """The batches of steps [first, last) on the device, made `depth` ahead; raises what `batches` raises."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="batches")
    waiting = deque()
    try:
        for step in range(first, last + depth):
            if step < last:
                waiting.append(pool.submit(lambda n: jax.device_put(batches(n)), step))
            if step >= first + depth:
                yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


class _Stop:
    """While open, the first SIGTERM or SIGINT is only noted in `signal`; a second one does its usual work."""

    def __enter__(self) -> "_Stop":
        self.signal: int | None = None
        self._usual = {}
        if threading.current_thread() is threading.main_thread():  # elsewhere Python takes no handlers
            self._usual = {s: signal.signal(s, self._note) for s in (signal.SIGTERM, signal.SIGINT)}
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: Any) -> None:
        self.signal = number
        self.__exit__()


class _Log:
    """metrics.csv, TensorBoard's events and the progress bar; the watch on numbers that are not finite."""

    def __init__(self, run: Run, config: Train, done: int, checkpoints: Checkpoints):
        self._run, self._config, self._first, self._checkpoints = run, config, done, checkpoints
        self._columns = _drop_rows_after(run.metrics, done)
        self._rows: list[dict[str, float]] = []  # of the steps since the last row on disk
        self._step = done
        self._events = SummaryWriter(str(run.events), purge_step=done + 1)
        terminal = sys.stderr.isatty()
        self._bar = tqdm(
            total=config.steps, initial=done, unit="step", dynamic_ncols=True, disable=not terminal
        )
        self._began = self._row_began = self._spoke = time.monotonic()

    def __enter__(self) -> "_Log":
        return self

    def __exit__(self, *_: Any) -> None:
        self._bar.close()
        self._events.close()

    def add(self, step: int, scalars: dict[str, Array]) -> None:
        """Take the scalars of a step, waiting for it; raise FloatingPointError where one is not finite."""
        scalars = jax.device_get(scalars)
        values = {name: float(scalars[name]) for name in ("loss", *scalars)}
        if wrong := [f"{name} = {value}" for name, value in values.items() if not math.isfinite(value)]:
            raise FloatingPointError(self._not_finite(step, ", ".join(wrong)))
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
        means["seconds"] = (now - self._row_began) / len(self._rows)  # a step, waiting for batches included
        for name, mean in means.items():
            self._events.add_scalar(name, mean, self._step)
        with open(self._run.metrics, "a", newline="") as file:
            columns = self._columns or ["step", *means]
            rows = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
            if not self._columns:
                rows.writeheader()
            rows.writerow({"step": self._step} | {name: f"{mean:.7g}" for name, mean in means.items()})
        self._columns, self._rows, self._row_began = columns, [], now

    def _show(self, loss: float) -> None:
        self._bar.set_postfix_str(f"loss {loss:.4g}", refresh=False)
        self._bar.update()
        now = time.monotonic()
        if self._bar.disable and now - self._spoke >= _SILENCE:
            pace = (now - self._began) / (self._step - self._first)
            left = tqdm.format_interval(pace * (self._config.steps - self._step))
            _say(f"step {self._step}/{self._config.steps}, loss {loss:.4g}, {pace:.3g} s a step, {left} left")
            self._spoke = now

    def _not_finite(self, step: int, wrong: str) -> str:
        kept = self._checkpoints.latest_step
        saved = "there is no checkpoint yet" if kept is None else f"the last checkpoint is step {kept}"
        clip = "lower train.clip" if self._config.clip else "set train.clip to 1"
        return (
            f"{self._run.folder}: step {step} gave {wrong}; {saved}; lower train.learning_rate "
            f"({self._config.learning_rate:g}) or {clip}, under another --name"
        )


def _drop_rows_after(metrics: Path, done: int) -> list[str]:
    """Keep the rows of a metrics.csv up to step `done`, as far as they are whole; return its columns."""
    if not metrics.exists():
        return []
    lines = [line for line in metrics.read_text().splitlines(keepends=True) if line.endswith("\n")]
    kept = lines[:1] + [line for line in lines[1:] if int(line.split(",")[0]) <= done]
    write_atomically(metrics, "".join(kept).encode())
    return kept[0].strip().split(",") if kept else []


def _say(message: str) -> None:
    tqdm.write(message, file=sys.stderr)  # beside a progress bar, not through it
