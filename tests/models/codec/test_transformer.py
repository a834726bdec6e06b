"""Law of attention: on vectors, that of their real pairs."""

import jax
import jax.numpy as jnp
import numpy as np

from flx.fields.algebra import complex_linear, real_pairs, tangent_noise
from flx.models.codec.transformer import Attention


def test_attention_is_that_of_real_pairs():
    """Against the library's attention over (re, im) pairs."""
    layer, x = Attention(4), tangent_noise(jax.random.key(0), (3, 7, 8))
    params = layer.init(jax.random.key(1), x)
    first, last = (params["params"][f"ComplexDense_{k}"]["kernel"] for k in (0, 1))

    def heads(part):
        return real_pairs(part.reshape(3, 7, 4, 2))

    q, k, v = (heads(part) for part in jnp.split(complex_linear(x, first), 3, -1))
    re, im = jnp.split(jax.nn.dot_product_attention(q, k, v, scale=2**-0.5), 2, -1)
    expected = complex_linear(jax.lax.complex(re, im).reshape(x.shape), last)
    np.testing.assert_allclose(layer.apply(params, x), expected, atol=1e-5)
