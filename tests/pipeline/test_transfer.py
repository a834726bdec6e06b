"""Laws of transfer: details keep their size in r̄, and moving or renumbering a mesh changes no colour."""

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.surfaces import icosphere, moved, square_grid, uneven_sphere
from hypothesis import given, settings
from hypothesis import strategies as st

from flx.assets.arrays import from_arrays
from flx.controls import Controls
from flx.fields.algebra import tangent_noise
from flx.fields.diffusion import Scaling
from flx.geometry.tables import mesh_tables
from flx.pipeline.canvas import bake, open_canvas
from flx.pipeline.generator import Home
from flx.pipeline.transfer import home_on, in_words, vertex_count
from flx.pipeline.variations import generate
from flx.types import MeshTables, Triangulation

SPHERE = icosphere(2)


def colored(mesh: Triangulation, name: str = "other.ply"):
    return from_arrays(*mesh, colors=np.full((len(mesh.vertices), 3), 0.5), name=name)


@settings(max_examples=10)
@given(scale=st.floats(0.3, 1.2), size=st.floats(0.9, 9.0))
def test_the_mean_vertex_radius_grows_with_the_scale_alone(generator, scale, size):
    """V · (size²) / scale², for a mesh of any size in the same units."""
    count = vertex_count(generator, colored(moved(SPHERE, 1, size)), scale)
    assert count == pytest.approx(162 * size**2 / scale**2, abs=0.5)
    other = Triangulation(100 * size * SPHERE.vertices, SPHERE.faces)  # centimetres for metres
    assert vertex_count(generator, colored(other), scale) == pytest.approx(162 / scale**2, abs=0.5)


def test_other_units_are_said_and_both_areas_too(generator):
    near, far = (colored(Triangulation(f * SPHERE.vertices, SPHERE.faces)) for f in (2, 1000))
    said = in_words(162, generator.asset, near)
    area = 4 * float(said.split("that of ")[1].split(";")[0].split()[-1])
    assert f"area {area:.4g}"[:9] in said and "648 vertices for the 162 there" in said and "units" not in said
    assert "162 vertices" in in_words(162, generator.asset, far) and "taken for other units" in in_words(
        162, generator.asset, far
    )


def test_a_scale_that_needs_too_few_or_too_many_vertices_names_one_that_does_not(generator):
    for scale, word in ((3.0, "less"), (0.01, "more")):
        with pytest.raises(ValueError, match=rf"at scale {scale:g}.*give --scale \S+ or {word}") as refusal:
            vertex_count(generator, generator.asset, scale)
        wanted = float(str(refusal.value).split("--scale ")[1].split()[0])
        assert 100 <= vertex_count(generator, generator.asset, wanted) <= 200_000
    for scale in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"scale is .*give a number"):
            Controls(scale=scale)


def test_another_mesh_has_no_texture_to_stay_near(generator):
    with pytest.raises(ValueError, match=r"strength is 0\.5; leave it out for another mesh, a\.glb"):
        Controls(mesh=Path("a.glb"), strength=0.5)
    with pytest.raises(ValueError, match=r"mask m\.png .*leave it out for another mesh"):
        Controls(mesh=Path("a.glb"), keep=Path("m.png"))
    other = colored(moved(SPHERE, 1, 1.5))
    with pytest.raises(ValueError, match="has no texture to stay near"):
        next(generate(generator, asset=other, controls=Controls(strength=0.5)))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_home_has_the_vertices_that_were_told(generator, scale, capsys):
    other = square_grid(10)  # open, and of another topology
    home = home_on(generator, colored(Triangulation(3 * other.vertices, other.faces)), scale)
    assert len(home.triangulation.vertices) == len(home.tables.fine.masses)
    assert f" {len(home.triangulation.vertices):,} vertices" in capsys.readouterr().err
    assert home_on(generator, generator.asset) is generator.home
    assert not capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_an_isometric_copy_gets_the_same_colours_for_the_same_noise(generator, seed):
    """Moved and renumbered; the noise is that of the first, in the frames of the copy."""
    first, order = uneven_sphere(seed, 120), np.random.default_rng(seed).permutation(120)
    place, turn = np.argsort(order), np.random.default_rng(seed + 1).permutation(236)
    shifted = moved(first, seed).vertices[order]
    faces = np.roll(place[first.faces], 1, axis=1)[turn[turn < len(first.faces)]]
    second = Triangulation(shifted, faces)
    # Pooling starts at a vertex that the seed chooses by its number: take the seed of the same one.
    tables = mesh_tables(first)
    wanted = set(tables.pooling.centers)
    copies = (mesh_tables(second, seed=s) for s in range(5000))
    copy = next(t for t in copies if {order[c] for c in t.pooling.centers} == wanted)
    noise = np.array(tangent_noise(jax.random.key(seed), (120, 8)))
    no_shift, one_scale = np.zeros(8, np.complex64), np.full(8, 2 + 2j, np.complex64)
    turning = replace(generator, scaling=Scaling(no_shift, one_scale))  # as vectors are scaled
    theirs = noise[order]
    # Both frames see the same neighbour: its direction in the copy, by that in the first.
    for v in range(120):
        there = int(copy.fine.neighbors[v, 1])
        slot = int(np.flatnonzero(tables.fine.neighbors[order[v]] == order[there])[0])
        ratio = copy.fine.logs[v, 1] / tables.fine.logs[order[v], slot]
        theirs[v, :5] *= ratio / abs(ratio)

    def colors(mesh: Triangulation, tables: MeshTables, noise: np.ndarray) -> np.ndarray:
        def start(z, s, key):
            return jnp.where(s > 12, jnp.asarray(noise, jnp.complex64), z)  # after the first step

        home = Home(mesh, tables)
        codes = turning.sample(jax.random.key(0), home, 3, "ddim", start)
        return bake(open_canvas(colored(mesh), mesh), turning.codec.decoder(codes)).colors

    seen, again = colors(first, tables, noise), colors(second, copy, theirs)
    assert np.ptp(seen) > 0.2
    np.testing.assert_allclose(again, seen[order], atol=1e-3)
    assert np.abs(colors(second, copy, noise[order]) - seen[order]).max() > 0.01  # frames do matter


class Waves(NamedTuple):
    """The denoiser whose samples are waves of a few mean vertex radii: noise, through a band of the ring's
    means. It knows the mesh by its tables alone, as a trained network does."""

    alphas: tuple[float, ...]

    def __call__(self, params: Any, tables: MeshTables, z: jax.Array, t: jax.Array) -> jax.Array:
        def mean(x):
            rings = tables.fine
            return (rings.weights[..., None] * x[rings.neighbors]).sum(1)

        x = z[:, 5:]  # channels that do not turn
        for _ in range(4):
            x = mean(x)
        low = x
        for _ in range(8):
            low = mean(low)
        band = x - low
        band = band / jnp.sqrt((jnp.abs(band) ** 2).mean())
        clean = jnp.concatenate([jnp.zeros_like(z[:, :5]), band], 1)
        alpha = jnp.asarray(self.alphas)[t.astype(int)]
        return (z - jnp.sqrt(alpha) * clean) / jnp.sqrt(1 - alpha)


@pytest.mark.slow
def test_scale_moves_the_spectrum_by_as_much(generator):
    """The mean frequency of waves on a square sheet, times the scale, stays the same within 10 %."""
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * 7.0
    uvs = np.array([(0, 0), (1, 0), (1, 1), (0, 1.0)])
    image = np.full((256, 256, 3), 128, np.uint8)
    sheet = from_arrays(corners, np.array([(0, 1, 2), (0, 2, 3)]), uvs, image, name="sheet.glb")
    waves = replace(
        generator,
        denoise=Waves(tuple(generator.alphas.tolist())),
        scaling=Scaling(generator.scaling.shift * 0, np.full(8, 4 + 4j, np.complex64)),
    )

    def frequency(scale: float) -> float:
        control = Controls(scale=scale, invention=1.0)
        paintings = generate(waves, 2, steps=2, sampler="ddim", asset=sheet, controls=control)
        power = 0.0
        for painting in paintings:
            gray = painting.images[0].astype(float).mean(2)
            window = np.hanning(len(gray))
            power = power + np.abs(np.fft.fft2((gray - gray.mean()) * np.outer(window, window))) ** 2
        at = np.hypot(*np.meshgrid(*[np.fft.fftfreq(256, 1 / 256)] * 2))
        assert np.asarray(power).max() > 0
        chosen = (at > 0) & (at < 60)
        return float(np.average(at[chosen], weights=np.asarray(power)[chosen]))

    found = [frequency(scale) * scale for scale in (0.5, 0.7, 1.0)]
    assert max(found) / min(found) < 1.1, found
