"""Laws of the layers that networks share."""

import jax
import jax.numpy as jnp
import numpy as np

from flx.models.layers import Posterior, timestep_features


def test_sampled_codes_have_the_mean_and_the_deviation_of_their_posterior():
    posterior = Posterior(jnp.full(100_000, 0.7 - 0.3j), jnp.full(100_000, -0.5))
    z = posterior.sample(jax.random.key(0))
    np.testing.assert_allclose(np.mean(z), 0.7 - 0.3j, atol=0.01)
    for coordinate in (np.real(z), np.imag(z)):
        np.testing.assert_allclose(np.std(coordinate), np.exp(-0.5), rtol=0.01)


def test_features_of_steps_add_as_angles():
    """As complex numbers f(a) f(b) = f(a + b), and steps of a thousand are told apart."""

    def f(t):
        cosines, sines = np.split(np.asarray(timestep_features(jnp.float32(t), 16)), 2)
        return cosines + 1j * sines

    np.testing.assert_allclose(f(3) * f(8), f(11), atol=1e-5)
    steps = np.stack([f(t) for t in range(0, 1000, 37)])
    apart = np.abs(steps[:, None] - steps[None]).max(-1) + np.eye(len(steps))
    assert apart.min() > 0.1
