"""Laws of the optimiser: its schedule, and who steps how far."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flx.config import Train
from flx.training.optimizer import ADAM_RATE, learning_rate, make_optimizer, muon
from flx.training.stacks import stacked, unstacked


@given(st.integers(2, 500), st.integers(0, 400), st.floats(1e-4, 1.0), st.floats(0.0, 1.0))
def test_the_learning_rate_warms_up_and_follows_a_cosine(steps, warmup, peak, share):
    c = Train(steps=steps, warmup=warmup, learning_rate=peak, final_learning_rate=share * peak)
    every = jnp.arange(500)  # of one shape whatever the example: compiled once
    rates = np.array(jax.vmap(lambda n: learning_rate(c, n))(every))[:steps]
    warmup = min(warmup, steps // 2)  # a short run of a long run's config still gets to its rate
    np.testing.assert_allclose(rates[:warmup], peak * np.arange(warmup) / max(warmup, 1), rtol=1e-5)
    np.testing.assert_allclose(rates[warmup], peak, rtol=1e-5)
    n = steps - warmup
    if n > 1:
        oracle = optax.cosine_decay_schedule(peak, n - 1, alpha=share)
        expected = jax.vmap(oracle)(every)[:n]
        np.testing.assert_allclose(rates[warmup:], expected, rtol=1e-4, atol=1e-6 * peak)
        np.testing.assert_allclose(rates[-1], share * peak, rtol=1e-5, atol=1e-6 * peak)


def test_adam_takes_the_scheduled_rate_and_clip_bounds_the_gradient():
    """The first step of Adam is the learning rate along the gradient's signs, whatever its length."""
    c = Train(steps=10, learning_rate=0.02, clip=1e-3)
    gradient = {"w": jnp.array([300.0, -400.0])}
    optimizer = make_optimizer(c)
    updates, moments = optimizer.update(gradient, optimizer.init(gradient), gradient)
    np.testing.assert_allclose(updates["w"], [-0.02, 0.02], rtol=1e-3)
    first_moment = optax.tree_utils.tree_get(moments, "mu")["w"]
    np.testing.assert_allclose(first_moment, 0.1 * 1e-3 * np.array([0.6, -0.8]), rtol=1e-5)


def test_muon_turns_matrices_by_the_rate_and_leaves_the_rest_to_adam():
    """Every singular value of a matrix' update is near the rate, whatever the gradient's; signs elsewhere.

    The iteration ends with singular values from about 0.7 to 1.2 (Jordan et al.).
    """
    rng = np.random.default_rng(0)
    gradient = {"6x8": rng.normal(size=(2, 6, 8)), "rest": rng.normal(size=8)}
    gradient["6x8"][0] *= 1e3
    gradient = jax.tree.map(jnp.float32, gradient)
    optimizer = make_optimizer(Train(steps=10, learning_rate=0.1, optimizer="muon"))
    updates = optimizer.update(gradient, optimizer.init(gradient), gradient)[0]
    scaled = np.linalg.svd(updates["6x8"], compute_uv=False) / (0.1 * np.sqrt(8 / 6))
    assert np.all((scaled > 0.6) & (scaled < 1.3))
    along = -updates["rest"] / np.sign(gradient["rest"])
    np.testing.assert_allclose(along, along[0], rtol=1e-3)  # Adam's first step knows the signs alone
    assert 1 < along[0] / (0.1 * ADAM_RATE) < 2  # longer than the rate by Nesterov's momentum


def test_muon_on_stacks_is_muon_on_each_kernel():
    """Kernels of one shape are updated together; each as if it were alone."""
    key = lambda n: jax.random.key(n)  # noqa: E731
    params = {
        "lift": {"kernel": jax.random.normal(key(0), (2, 5, 8)), "bias": jax.random.normal(key(1), (8,))},
        "before": {"kernel": jax.random.normal(key(2), (3, 2, 5, 8)), "scale": jnp.ones((3, 4))},
        "head": {"output": jax.random.normal(key(3), (8, 5))},
    }
    rate = lambda step: 0.1 / (1 + step)  # noqa: E731
    dimensions = jax.tree.map_with_path(
        lambda path, a: (
            optax.contrib.MuonDimensionNumbers(a.ndim - 2, a.ndim - 1)
            if path[-1].key in ("kernel", "output")
            else None
        ),
        params,
    )
    slower = lambda step: ADAM_RATE * rate(step)  # noqa: E731
    plain = optax.contrib.muon(
        rate, adam_learning_rate=slower, muon_weight_dimension_numbers=lambda _: dimensions
    )
    both = []
    for optimizer, start in ((plain, params), (muon(rate), stacked(params, matrices=True))):
        state, moved = optimizer.init(start), start
        for n in range(3):
            gradient = jax.tree.map(lambda p, n=n: jnp.sin(p + n), moved)
            updates, state = optimizer.update(gradient, state, moved)
            moved = optax.apply_updates(moved, updates)
        both.append(moved)
    for a, b in zip(*map(jax.tree.leaves, (both[0], unstacked(both[1], params))), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("matrices", [True, False])
def test_stacks_hold_each_parameter_once_and_give_it_back(matrices):
    key = jax.random.key(0)
    params = {
        "lift": {"kernel": jax.random.normal(key, (2, 5, 8)), "bias": jnp.arange(8.0)},
        "before": {
            "kernel": jax.random.normal(key, (3, 2, 5, 8)),
            "bias": jnp.ones((3, 8)),
            "size": jnp.float32(7),
        },
        "head": {"kernel": jax.random.normal(key, (8, 5))},
    }
    stacks = stacked(params, matrices)
    shapes = {"5x8": (8, 5, 8), "8x5": (1, 8, 5), "rest": (33,)} if matrices else {"rest": (393,)}
    assert {name: a.shape for name, a in stacks.items()} == shapes
    back = unstacked(stacks, jax.eval_shape(lambda: params))
    jax.tree.map(np.testing.assert_array_equal, back, params)
    bare = jnp.array([5.0, -3.0])  # a network of one array
    np.testing.assert_array_equal(unstacked(stacked(bare, matrices), bare), bare)
