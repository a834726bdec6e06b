"""Laws of guidance: a line through two predictions, and conditions that are dropped as a whole."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from flx.fields.algebra import tangent_noise
from flx.fields.guidance import Condition, dropped, guided

RHO = jnp.eye(3)[jnp.arange(20) % 3]
BARE = tangent_noise(jax.random.key(0), (20, 8))


WAY = jnp.exp(1j * jnp.arange(20.0))[:, None]


def noise(rho, direction=None):
    seen = 0 if rho is None else rho @ jnp.arange(24.0).reshape(3, 8)
    return BARE + jnp.sin(seen) + (0 if direction is None else direction * jnp.arange(8.0))


def test_weight_0_is_unconditional_and_weight_1_conditional():
    for weight, expected in ((0, noise(0 * RHO)), (1, noise(RHO))):
        np.testing.assert_array_equal(guided(noise, Condition(RHO, jnp.float32(weight))), expected)
    np.testing.assert_array_equal(guided(noise, Condition(RHO)), noise(RHO))
    assert np.abs(noise(RHO) - noise(0 * RHO)).max() > 0.5


def test_a_direction_is_weighed_as_labels_are_and_together_with_them():
    twice = jnp.float32(2)
    for rho in (None, RHO):
        bare, told = noise(None if rho is None else 0 * rho), noise(rho, WAY)
        found = guided(noise, Condition(rho, twice, WAY))
        np.testing.assert_allclose(found, 2 * told - bare, atol=1e-5)
        np.testing.assert_array_equal(guided(noise, Condition(rho, None, WAY)), told)
        assert np.abs(told - bare).max() > 0.5
    np.testing.assert_array_equal(guided(noise, Condition()), BARE)


@given(weight=st.floats(0, 8))
def test_guidance_goes_on_in_the_direction_of_the_labels(weight):
    bare, told = noise(0 * RHO), noise(RHO)
    found = guided(noise, Condition(RHO, jnp.float32(weight)))
    np.testing.assert_allclose(found - bare, weight * (told - bare), atol=1e-5)


def test_a_draw_loses_all_of_its_conditions_or_none():
    keys = jax.random.split(jax.random.key(1), 2000)
    drawn = jax.vmap(lambda key: dropped(key, RHO, 0.15))(keys)
    lost = np.asarray((drawn == 0).all((1, 2)))
    np.testing.assert_array_equal(drawn[~lost], np.broadcast_to(RHO, ((~lost).sum(), 20, 3)))
    assert abs(lost.mean() - 0.15) < 0.03  # four standard deviations
