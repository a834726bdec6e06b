"""One training loop for both models: Adam or Muon, a cosine schedule, averaged parameters, checkpoints.

Step n (from 0) sees `batches(n)` and the key `fold_in(seed, n)`, whatever happened before it: a run that was
killed and called again takes the steps it would have taken. "Step" in metrics.csv, in messages and in the
names of checkpoints is the number of steps done. A row of metrics.csv is the mean over the steps since
the row before; a checkpoint ends a row.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array
from jaxtyping import Int32, UInt32

from flx.config import Train
from flx.stopping import Noted
from flx.training.checkpoint import Checkpoints
from flx.training.devices import Devices, devices_for
from flx.training.log import Log, Silent, say
from flx.training.optimizer import learning_rate, make_optimizer
from flx.training.run import Run, only_trainer
from flx.training.stacks import Stacks, stacked, unstacked

LossFn = Callable[[Any, Any, Array], tuple[Array, dict[str, Array]]]  # parameters, batch, key → loss, metrics
Batches = Callable[[int], Any]  # step → this process's rows of the batch, always the same for a step


class TrainState(NamedTuple):
    """All that the next step depends on. `Any` is a pytree of arrays."""

    step: Int32[Any, ""]  # steps done
    params: Stacks
    ema: Stacks  # the average that sampling uses
    optimizer: Any
    key: UInt32[Any, "2"]  # of the run


def initial_state(config: Train, init_params: Any) -> TrainState:
    """The state before the first step; its arrays are copies, for a step takes the buffers of its state."""
    stacks = stacked(init_params, config.optimizer == "muon")
    params, ema = jax.tree.map(jnp.array, stacks), jax.tree.map(jnp.array, stacks)
    key = jax.random.key_data(jax.random.key(config.seed))
    return TrainState(jnp.int32(0), params, ema, make_optimizer(config).init(params), key)


def averaged(state: TrainState, like: Any) -> Any:
    """The averaged parameters, in the shapes of `like`."""
    return unstacked(state.ema, like)


def restore(run: Run, config: Train, init_params: Any) -> TrainState:
    """The newest checkpoint of a run, as NumPy arrays; `init_params` may be `jax.ShapeDtypeStruct`s.

    Raises ValueError where the run has no checkpoint, or one of another network.
    """
    template = jax.eval_shape(lambda params: initial_state(config, params), init_params)
    restored = Checkpoints(run.checkpoints).restore_latest(template)
    if restored is None:
        raise ValueError(f"{run.folder} has no checkpoint yet; train it first with `flx train`")
    return restored[1]


def make_step(
    config: Train, loss_fn: LossFn, like: Any
) -> Callable[[TrainState, Any], tuple[TrainState, dict[str, Array]]]:
    """One step: `(state, batch) → (next state, scalars)`. Pure; `jit` it.

    The parameters that `loss_fn` takes have the shapes of `like`.
    The decay of the average is min(ema, (1 + n)/(10 + n)) at step n: it soon forgets the initial parameters.
    """
    optimizer, slope = make_optimizer(config), in_parts(loss_fn, config.accumulate)

    def step(state: TrainState, batch: Any) -> tuple[TrainState, dict[str, Array]]:
        n = state.step
        key = jax.random.fold_in(jax.random.wrap_key_data(state.key), n)
        (loss, metrics), gradient = slope(unstacked(state.params, like), batch, key)
        gradient = stacked(gradient, config.optimizer == "muon")
        updates, moments = optimizer.update(gradient, state.optimizer, state.params)
        params: Any = optax.apply_updates(state.params, updates)
        decay = jnp.minimum(config.ema, (1 + n) / (10 + n))
        ema = jax.tree.map(lambda average, p: average + (1 - decay) * (p - average), state.ema, params)
        # The norm is plotted, and checked: a finite loss may have a gradient that is not finite.
        scalars = {"loss": loss, "gradient_norm": optax.global_norm(gradient)}
        scalars |= {"learning_rate": learning_rate(config, n), **metrics}
        return TrainState(n + 1, params, ema, moments, state.key), scalars

    return step


def in_parts(loss_fn: LossFn, parts: int) -> Callable[[Any, Any, Array], Any]:
    """((loss, metrics), gradient) of a batch, worked on in parts: the loss is a mean over the batch's rows.

    Part i has every row i + parts·n: where devices share the rows, they share each part.
    """
    whole = jax.value_and_grad(loss_fn, has_aux=True)
    if parts == 1:
        return whole

    def slope(params: Any, batch: Any, key: Array) -> Any:
        each = jax.tree.map(lambda a: a.reshape(-1, parts, *a.shape[1:]).swapaxes(0, 1), batch)
        first = jax.tree.map(lambda a: a[0], each)
        none = jax.tree.map(jnp.zeros_like, jax.eval_shape(whole, params, first, key))

        def add(total: Any, part: Any) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, whole(params, part, key)), None

        total, _ = jax.lax.scan(add, none, each)
        return jax.tree.map(lambda a: a / parts, total)

    return slope


def train(
    run: Run,
    config: Train,
    init_params: Any,
    loss_fn: LossFn,
    batches: Batches,
    save: Callable[[int, Any], None] | None = None,
    devices: Devices | None = None,
) -> TrainState:
    """Train from the newest checkpoint, or from `init_params`, to `config.steps`; return the state there.

    `loss_fn(params, batch, key) → (loss, scalars by name)` is pure; `batches(step)` is a pytree of fresh
    arrays, of the same shapes at each step, made in a thread of its own. `save(step, averaged parameters)` is
    called at each checkpoint. On a signal to stop, the step is finished, its state saved and SystemExit(128 +
    signal) raised; a second one acts at once. Of several processes, the leading one writes, and all stop at
    the same step. On one device unless `devices` are given.
    Raises FloatingPointError at the first step with a number that is not finite (the checkpoint before it
    stays), and ValueError where another process trains here.
    """
    devices = devices or devices_for(config.batch, wanted=1)
    host = devices.host
    with only_trainer(run) if host.leads else contextlib.nullcontext():
        checkpoints = Checkpoints(run.checkpoints)
        state = initial_state(config, init_params)
        if host.leads and (restored := checkpoints.restore_latest(state)):
            state = restored[1]
            say(f"{run.folder}: resumed at step {restored[0]} of {config.steps}")
        state = devices.on_each(state)
        done = int(state.step)
        if done >= config.steps:
            return devices.here(state)
        with contextlib.closing(_prefetch(batches, devices, done, config.steps)) as feed:
            batch = next(feed)
            began = time.monotonic()
            step = (
                jax.jit(_heeding(make_step(config, loss_fn, init_params)), **devices.rules, donate_argnums=0)
                .lower(state, batch, devices.each_says(0))
                .compile()
            )
            if host.leads:
                say(f"{run.folder}: compiled the train step in {time.monotonic() - began:.1f} s")
            report = Log(run, config, done, checkpoints) if host.leads else Silent(run, config, checkpoints)
            with Noted() as stop, contextlib.closing(report) as log:
                under_way, heard, signal = None, 0, None  # the scalars of the step that the device works on
                while True:
                    state, scalars, hears = step(state, batch, devices.each_says(stop.signal or 0))
                    if under_way:
                        log.add(done, under_way)  # waits for the step before: the host runs one step ahead
                    # Several processes must stop at the same step: when all have heard of it.
                    signal = stop.signal if host.count == 1 else int(heard) or None
                    done, under_way, heard = done + 1, scalars, hears
                    last = done == config.steps or signal is not None
                    if last or done % config.checkpoint_every == 0:
                        log.add(done, under_way)  # first: a state that is not finite is never saved
                        log.write()
                        if host.leads:
                            ours = devices.here(state)
                            if save is not None:  # first: what it writes is never behind a checkpoint
                                save(done, averaged(ours, init_params))
                            checkpoints.save(done, ours)
                        under_way = None
                    if last:
                        log.finish()
                        break
                    batch = next(feed)
        if signal is not None and done < config.steps:
            if host.leads:
                say(f"{run.folder}: stopped, saved at step {done}; the same command goes on from there")
            raise SystemExit(128 + signal)
        return devices.here(state)


def _heeding(step: Callable[[TrainState, Any], tuple[TrainState, dict[str, Array]]]) -> Callable[..., Any]:
    """The step with, for each device, a signal that its process received, or 0; returns the largest, too."""
    return lambda state, batch, signals: (*step(state, batch), jnp.max(signals))


def kept(run: Run) -> str:
    """What of a run an interruption keeps, and how to go on."""
    step = Checkpoints(run.checkpoints).latest_step
    saved = "no step is saved yet, what is prepared is kept" if step is None else f"saved at step {step}"
    return f"{run.folder}: {saved}; the same command goes on from there"


def _prefetch(
    batches: Batches, devices: Devices, first: int, last: int, depth: int = 2
) -> Generator[Any, None, None]:
    """The batches of steps [first, last) on the devices, made `depth` ahead; raises what `batches` raises."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="batches")
    waiting = deque()
    try:
        for step in range(first, last + depth):
            if step < last:
                waiting.append(pool.submit(lambda n: devices.spread(batches(n)), step))
            if step >= first + depth:
                yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
