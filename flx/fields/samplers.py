"""Samplers: from noise to data with a denoising function. Each reads like the algorithm in its paper.

A sampler is a table with a row for each step from t to s < t, and a function that uses one row:

    step(row, denoise, z, memory, noise) → z at s, memory

Coefficients are computed in NumPy float64 outside of the scan, because 1 − α_t near α_t = 1 would lose its
digits in float32. `memory` is the state of a multistep solver. `reverse` scans the table; after each step it
calls a hook that may change z, for inpainting and guidance. `repeated` walks parts of a table several times.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Complex, Float, Float64

from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import Denoise, diffuse

Hook = Callable[[Complex[Array, "V D"], Float[Array, ""], Array], Complex[Array, "V D"]]  # z, s, key → z


class Sampler(NamedTuple):
    """A row for each step, in order; all rows have `t` and `s`."""

    table: dict[str, Float64[np.ndarray, "N"]]
    step: Callable[..., tuple[Array, Any]]
    memory: Callable[[Array], Any]  # the memory before the first step, from Z_T


def ancestral(alphas: Float64[np.ndarray, "T"]) -> Sampler:
    """DDPM (Ho et al. 2020, algorithm 2; paper, supplement): the exact posterior, from t = T to 1.

    With a = α_t/α_{t−1}: C₁ = 1/√a, C₂ = −(1−a)/√(a(1−α_t)), C₃ = √((1−α_{t−1})(1−a)/(1−α_t)). The paper
    prints C₂ as a product of two roots; it is their difference, here in a form without cancellation.
    C₃ is 0 at t = 1.
    """
    t = np.arange(len(alphas) - 1, 0, -1)
    now, before = alphas[t], alphas[t - 1]
    a = now / before
    c1, c2 = 1 / np.sqrt(a), -(1 - a) / np.sqrt(a * (1 - now))
    c3 = np.sqrt((1 - before) * (1 - a) / (1 - now))
    return Sampler({"t": t, "s": t - 1, "c1": c1, "c2": c2, "c3": c3}, _ancestral_step, nothing)


def _ancestral_step(row: Any, denoise: Denoise, z: Array, memory: Any, noise: Array) -> tuple[Array, Any]:
    return row["c1"] * z + row["c2"] * denoise(z, row["t"]) + row["c3"] * noise, memory


def ddim(alphas: Float64[np.ndarray, "T"], count: int) -> Sampler:
    """Deterministic steps (Song et al. 2021, η = 0), evenly spaced in t, the last one to t = 0.

    Ẑ = (Z_t − √(1−α_t) ε̂)/√α_t, then Z_s = √α_s Ẑ + √(1−α_s) ε̂. Raises ValueError as `spaced` does.
    """
    t, s = spaced(alphas, count)
    c1 = np.sqrt(alphas[s] / alphas[t])  # the coefficient of Z_t
    c2 = np.sqrt(1 - alphas[s]) - c1 * np.sqrt(1 - alphas[t])  # the coefficient of ε̂
    return Sampler({"t": t, "s": s, "c1": c1, "c2": c2}, _ddim_step, nothing)


def _ddim_step(row: Any, denoise: Denoise, z: Array, memory: Any, noise: Array) -> tuple[Array, Any]:
    return row["c1"] * z + row["c2"] * denoise(z, row["t"]), memory


def dpm_solver(alphas: Float64[np.ndarray, "T"], count: int) -> Sampler:
    """DPM-Solver++(2M) (Lu et al. 2022, algorithm 2): second order, with the Ẑ of the step before.

    With λ = ln √(α/(1−α)), h = λ_s − λ_t and r = h_before/h:
    D = (1 + 1/2r) Ẑ_t − 1/2r Ẑ_before, then Z_s = √((1−α_s)/(1−α_t)) Z_t − √α_s (e^{−h} − 1) D.
    The first step, and the last one, whose h is infinite, are of first order. Raises ValueError as `spaced`.
    """
    t, s = spaced(alphas, count)
    with np.errstate(divide="ignore"):
        log_snr = np.log(alphas / (1 - alphas)) / 2
    h = log_snr[s] - log_snr[t]
    ratio = np.zeros(count)
    ratio[1:] = h[1:] / h[:-1] / 2  # 1/2r
    ratio[-1] = 0
    decay, gain = np.sqrt((1 - alphas[s]) / (1 - alphas[t])), -np.sqrt(alphas[s]) * np.expm1(-h)
    rows = {"t": t, "s": s, "ratio": ratio, "decay": decay, "gain": gain}
    rows |= {"signal": np.sqrt(alphas[t]), "deviation": np.sqrt(1 - alphas[t])}
    return Sampler(rows, _dpm_step, jnp.zeros_like)


def _dpm_step(row: Any, denoise: Denoise, z: Array, before: Array, noise: Array) -> tuple[Array, Array]:
    data = (z - row["deviation"] * denoise(z, row["t"])) / row["signal"]  # Ẑ_t
    mixed = data + row["ratio"] * (data - before)  # D
    return row["decay"] * z + row["gain"] * mixed, data


def spaced(alphas: Float64[np.ndarray, "T"], count: int) -> tuple[np.ndarray, np.ndarray]:
    """`count` steps from T to 0 as (t, s), as even as integers allow.

    Raises ValueError if the schedule has fewer steps.
    """
    total = len(alphas) - 1
    if not 1 <= count <= total:
        raise ValueError(f"the sampler has {count} steps but the schedule {total}; ask for 1 to {total}")
    times = np.rint(np.linspace(total, 0, count + 1)).astype(int)
    return times[:-1], times[1:]


def repeated(sampler: Sampler, alphas: Float64[np.ndarray, "T"], length: int, times: int) -> Sampler:
    """Each stretch of `length` steps 1 + `times` times (RePaint, Lugmayr et al. 2022, algorithm 1).

    Between two times, noise leads from the end of the stretch back to its start: Z_t = √a Z_s + √(1−a) ε with
    a = α_t/α_s, the column `back`, which is 1 elsewhere; `s` is then the time that the noise leads to. A
    multistep solver forgets at each return: its Ẑ belongs to another noise, so the next step is of first
    order.
    """
    count = len(sampler.table["t"])
    starts = range(0, count, length)
    order = np.concatenate([np.tile(np.arange(a, min(a + length, count)), 1 + times) for a in starts])
    table = {name: column[order] for name, column in sampler.table.items()}
    reached, onward = table["s"], np.append(table["t"][1:], 0)
    table |= {"s": onward, "back": alphas[onward] / alphas[reached]}
    if "ratio" in table:
        table["ratio"] = np.where(np.roll(reached != onward, 1), 0, table["ratio"])
    return sampler._replace(table=table)


def sampler_named(
    name: str,
    alphas: Float64[np.ndarray, "T"],
    steps: int,
    strength: float = 1.0,
    repeats: tuple[int, int] | None = None,
) -> Sampler:
    """A sampler of the last `strength` of a schedule, with as large a share of `steps`, some repeated.

    Raises ValueError for a name that is not known, and for more steps than the schedule has.
    """
    alphas, steps = alphas[: 1 + max(1, round(strength * (len(alphas) - 1)))], max(1, round(strength * steps))
    if name == "ancestral":
        chosen = ancestral(alphas)
    elif name in SPACED:
        chosen = SPACED[name](alphas, steps)
    else:
        raise ValueError(f"there is no sampler {name!r}; choose one of ddim, dpm, ancestral")
    return repeated(chosen, alphas, *repeats) if repeats else chosen


SPACED = {"ddim": ddim, "dpm": dpm_solver}  # those that take as many steps as they are told


def nothing(z: Array) -> tuple[()]:
    """The memory of a sampler without memory."""
    return ()


def reverse(
    denoise: Denoise, sampler: Sampler, z: Complex[Array, "*V D"], key: Array, hook: Hook | None = None
) -> Complex[Array, "*V D"]:
    """Run a sampler as one scan from Z_T = `z` (tangent noise) to Z_0.

    Step n draws its noise with fold_in(key, n). `hook(z, s, key)` receives the z that the step reached at
    time s and a key of its own; the next step starts from the z that it returns.
    """

    def step(carry: tuple[Array, Any], row: dict[str, Array]) -> tuple[tuple[Array, Any], None]:
        z, memory = carry
        step_key = jax.random.fold_in(key, row["n"])
        noise = tangent_noise(step_key, z.shape).astype(z.dtype)
        z, memory = sampler.step(row, denoise, z, memory, noise)
        if "back" in row:
            fresh = tangent_noise(jax.random.fold_in(step_key, 2), z.shape).astype(z.dtype)
            z = diffuse(z, fresh, row["back"])
        if hook is not None:
            z = hook(z, row["s"], jax.random.fold_in(step_key, 1))
        return (z, memory), None

    real = jnp.real(z).dtype
    table = {name: jnp.asarray(column, real) for name, column in sampler.table.items()}
    table["n"] = jnp.arange(len(table["t"]))
    return jax.lax.scan(step, (z, sampler.memory(z)), table)[0][0]
