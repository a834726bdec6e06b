"""Laws of the scaling between latents and what is diffused."""

import numpy as np
from shapes import square_grid

from flx.mesh.tables import mesh_tables
from flx.pipeline.learn import latent_scaling
from flx.pipeline.prepare import Prepared


def copy_of(latents: np.ndarray) -> Prepared:
    """A copy of which only the latents matter here."""
    sheet = square_grid(4)
    return Prepared(sheet, mesh_tables(sheet), latents)


def test_scaling_is_undone_turns_with_the_frame_and_has_the_size_of_noise():
    rng = np.random.default_rng(0)
    spread = np.array([3, 0.1, 5, 0.2]) + 1j * np.array([3, 0.1, 0.3, 7])
    z = rng.normal(size=(5000, 4)) * spread.real + 1j * rng.normal(size=(5000, 4)) * spread.imag
    z = (z + np.array([0, 0, 9 - 4j, 2j])).astype(np.complex64)
    scaling = latent_scaling([copy_of(z[:2500]), copy_of(z[2500:])], invariants=2)
    scaled = scaling.to_diffusion(z)
    np.testing.assert_allclose(scaling.to_latents(scaled), z, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.abs(scaled[:, :2]).mean(0), np.sqrt(np.pi / 2), rtol=1e-3)
    for part in (scaled[:, 2:].real, scaled[:, 2:].imag):
        np.testing.assert_allclose(part.mean(0), 0, atol=1e-3)
        np.testing.assert_allclose(part.std(0), 1, rtol=1e-3)

    turn = np.exp(1j * rng.uniform(-np.pi, np.pi, (5000, 1))) ** np.array([1, 1, 0, 0])
    turned = scaling.to_diffusion((z * turn).astype(np.complex64))
    np.testing.assert_allclose(turned, scaled * turn, atol=1e-4)
