"""Symmetries of the whole networks, to nine digits: everything here runs in float64.

In float32 rounding hides a small break of symmetry. Here tables, parameters and fields are float64, and
nothing passes.
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.frames import relative, renumbered, turned
from helpers.surfaces import icosphere, moved, sheet

from flx.config import FLDM, FLVAE
from flx.geometry.tables import exact_tables, stack
from flx.geometry.tangent import corner_logs, tangent_frames
from flx.models.codec.vae import FieldLatentVAE
from flx.models.denoiser.mixed import MixedDenoiser
from flx.models.denoiser.vectors import Denoiser
from flx.pipeline.codec import initial_params
from flx.types import OneRings, Queries, RingSamples, Triangulation

EXACT = 1e-9
SMALL = FLDM(network="vectors", latents=3, channels=4, vn_layers=2, filter_width=6, embedding=8, conditions=2)
SMALL = replace(SMALL, directions=1)
DENOISERS = {
    "harmonic": SMALL,
    "mlp": replace(SMALL, filter="mlp"),
    "mixed": replace(SMALL, network="mixed", latents=5, invariants=2),
}


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def hill() -> Triangulation:
    """An open, curved, irregular surface of 56 vertices, where no two paths tie."""
    flat = sheet(3, rows=7, columns=8)
    height = np.random.default_rng(3).uniform(0, 0.8, len(flat.vertices))
    return Triangulation(flat.vertices + height[:, None] * [0, 0, 1], flat.faces)


HILL = hill()
COUNT = len(HILL.vertices)


def noise(seed: int, *shape: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def random_parameters(shapes: Any) -> Any:
    """All of them, biases and scales too: a symmetry must not hang on where they start."""
    rng = np.random.default_rng(0)
    return jax.tree.map(
        lambda a: jnp.asarray(rng.normal(size=a.shape) / np.sqrt(a.shape[-2] if a.ndim > 1 else 4)), shapes
    )


def shuffled_faces(mesh: Triangulation) -> Triangulation:
    """The same surface in other frames: the order of faces decides where rings start."""
    return Triangulation(mesh.vertices, np.random.default_rng(1).permutation(mesh.faces))


def frame_turns(before: OneRings, after: OneRings) -> np.ndarray:
    """How far a vector turns from the frames of one table to those of another, as unit numbers."""
    there = np.argmax(after.neighbors == before.neighbors[:, 1:2], axis=1)
    turn = after.logs[np.arange(len(there)), there] / before.logs[:, 1]
    np.testing.assert_allclose(np.abs(turn), 1, rtol=1e-12)
    return turn


# ---- denoisers -----------------------------------------------------------------------------------------


class Network(NamedTuple):
    config: FLDM
    answer: Any  # tables, z, ρ, d → ε, compiled
    gradient: Any  # tables, z, ρ, d, target → of ⟨target, ε⟩ by the parameters
    params: Any

    def code_turn(self, turn: np.ndarray) -> np.ndarray:
        """Factors [V, D]: vectors turn with the frames, invariant channels do not."""
        vectors = np.arange(self.config.latents) < self.config.code_channels[0]
        return np.where(vectors, turn[:, None], 1)


TABLES = exact_tables(HILL)
RHO = np.random.default_rng(5).normal(size=(COUNT, 2))
WAY = np.exp(1j * np.random.default_rng(7).uniform(-np.pi, np.pi, (COUNT, 1)))  # the direction


@functools.cache
def network_of(name: str) -> Network:
    config = DENOISERS[name]
    network: Any = {"vectors": Denoiser, "mixed": MixedDenoiser}[config.network](config, (1, 1, 1))
    z = noise(0, COUNT, config.latents)
    shapes = jax.eval_shape(network.init, jax.random.key(0), TABLES, z, jnp.float64(300), RHO, WAY)
    params = random_parameters(shapes)

    def answer(params, tables, z, rho, way):
        return network.apply(params, tables, z, jnp.float64(300), rho, way)

    def inner(params, tables, z, rho, way, target):
        return jnp.sum(jnp.real(jnp.conj(target) * answer(params, tables, z, rho, way)))

    return Network(config, jax.jit(answer), jax.jit(jax.grad(inner)), params)


networks = pytest.mark.parametrize("name", DENOISERS)


@pytest.mark.slow
@networks
def test_denoisers_turn_with_the_frames(name):
    """Frames turned at random; and the frames of the same mesh with its faces in another order."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    here = network.answer(network.params, TABLES, z, RHO, WAY)
    alpha = np.random.default_rng(0).uniform(-np.pi, np.pi, COUNT)
    rebuilt = exact_tables(shuffled_faces(HILL))
    np.testing.assert_array_equal(rebuilt.pooling.centers, TABLES.pooling.centers)
    cases = (turned(TABLES, alpha), np.exp(1j * alpha)), (rebuilt, frame_turns(TABLES.fine, rebuilt.fine))
    for tables, turn in cases:
        assert np.abs(turn - 1).max() > 0.1
        turns = network.code_turn(turn)
        there = network.answer(network.params, tables, z * turns, RHO, WAY * turn[:, None])
        assert there.dtype == np.complex128
        assert relative(there, here * turns) < EXACT
        for field, way in ((z, WAY * turn[:, None]), (z * turns, WAY)):  # one of the two does not turn
            assert relative(network.answer(network.params, tables, field, RHO, way), here * turns) > 1e-3


@pytest.mark.slow
@networks
def test_denoisers_see_no_motion_and_no_scale(name):
    """Tables rebuilt from a mesh that was turned, shifted and made 37 times as large."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    here = network.answer(network.params, TABLES, z, RHO, WAY)
    for mesh in (moved(HILL, 1), moved(HILL, 2, 37.0)):
        assert relative(network.answer(network.params, exact_tables(mesh), z, RHO, WAY), here) < EXACT
    stretched = exact_tables(Triangulation(HILL.vertices * [1, 1.1, 1], HILL.faces))
    assert relative(network.answer(network.params, stretched, z, RHO, WAY), here) > 1e-4


@pytest.mark.slow
@networks
def test_denoisers_do_not_mind_the_numbering(name):
    """Rows of both levels in another order."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    rng = np.random.default_rng(2)
    fine, coarse = rng.permutation(COUNT), rng.permutation(len(TABLES.coarse.masses))  # new i is old order[i]
    here = network.answer(network.params, TABLES, z, RHO, WAY)
    tables = renumbered(TABLES, fine, coarse)
    there = network.answer(network.params, tables, z[fine], RHO[fine], WAY[fine])
    assert relative(there, here[fine]) < EXACT
    assert relative(network.answer(network.params, tables, z, RHO, WAY), here) > 1e-3


@pytest.mark.slow
@networks
def test_denoisers_do_not_see_padding(name):
    """Beside a larger copy: spare slots, vertices, clusters and children, and any number in spare rows."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    here = network.answer(network.params, TABLES, z, RHO, WAY)
    both = stack([TABLES, exact_tables(icosphere(2))])
    tables = jax.tree.map(lambda a: a[0], both)
    spare = len(tables.fine.masses) - COUNT
    assert spare > 50 and len(tables.coarse.masses) > len(TABLES.coarse.masses)
    filled = np.concatenate([z, 7 * noise(1, spare, z.shape[1])])
    rho, way = (np.pad(a, ((0, spare), (0, 0)), constant_values=5) for a in (RHO, WAY))
    there = network.answer(network.params, tables, filled, rho, way)
    assert relative(there[:COUNT], here) < EXACT


@pytest.mark.slow
@networks
def test_no_direction_is_as_if_none_had_been_learnt(name):
    """A zero vector everywhere: the network without its maps of the direction."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    here = network.answer(network.params, TABLES, z, RHO, 0 * WAY)
    params = {k: v for k, v in network.params["params"].items() if not k.startswith("direction_")}
    assert len(params) == len(network.params["params"]) - 3
    kind = {"vectors": Denoiser, "mixed": MixedDenoiser}[network.config.network]
    bare = kind(replace(network.config, directions=0), (1, 1, 1))
    there = jax.jit(bare.apply)({"params": params}, TABLES, z, jnp.float64(300), RHO)
    assert relative(there, here) < EXACT
    assert relative(network.answer(network.params, TABLES, z, RHO, WAY), here) > 1e-2


@pytest.mark.slow
@networks
def test_detail_goes_around_the_coarse_level(name):
    """Where nothing is pooled and nothing comes back from below, a change is still seen: along the skip."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    p = TABLES.pooling
    cut = TABLES._replace(pooling=p._replace(child_weights=0 * p.child_weights, transports=0 * p.transports))
    pushed = z + 5 * (np.arange(COUNT) == 9)[:, None]
    here, there = (network.answer(network.params, cut, a, RHO, WAY) for a in (z, pushed))
    change = np.abs(there - here).max(1)
    assert change[9] > 3 * np.median(change) > 0  # the rest moves a little: norms see the whole surface


@pytest.mark.slow
@networks
def test_gradients_of_denoisers_are_slopes_and_know_no_frame(name):
    """Against a central difference along a random direction in all parameters; and in other frames."""
    network, z = network_of(name), noise(0, COUNT, DENOISERS[name].latents)
    target = noise(4, COUNT, z.shape[1])
    gradient = network.gradient(network.params, TABLES, z, RHO, WAY, target)
    leaves, tree = jax.tree.flatten(network.params)
    rng = np.random.default_rng(6)
    direction = jax.tree.unflatten(tree, [rng.normal(size=a.shape) for a in leaves])

    def along(step: float) -> float:
        moved = jax.tree.map(lambda a, d: a + step * d, network.params, direction)
        return np.sum(np.real(np.conj(target) * network.answer(moved, TABLES, z, RHO, WAY)))

    slope = sum(
        np.sum(g * d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    measured = (along(1e-7) - along(-1e-7)) / 2e-7  # longer steps meet kinks
    np.testing.assert_allclose(slope, measured, rtol=1e-6)

    alpha = np.random.default_rng(0).uniform(-np.pi, np.pi, COUNT)
    turn, turns = np.exp(1j * alpha)[:, None], network.code_turn(np.exp(1j * alpha))
    there = turned(TABLES, alpha), z * turns, RHO, WAY * turn, target * turns
    again = network.gradient(network.params, *there)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        other = functools.reduce(lambda node, key: node[key.key], path, again)
        np.testing.assert_allclose(other, leaf, rtol=0, atol=EXACT * np.abs(leaf).max(), err_msg=str(path))


# ---- FL-VAE --------------------------------------------------------------------------------------------

TINY = FLVAE(channels=8, layers=2, heads=2, samples=20, latents=5, decoder_width=16)
FRAME = replace(TINY, encoder="frame", invariants=2, width=16, depth=1, edges=5, sharpness=2.0)
INTERPOLATED = replace(FRAME, decoder="interpolated", sharpness=1.0)
CODECS = {
    "transformer": TINY,
    "frame": FRAME,
    "vectors": replace(FRAME, invariants=0),
    "interpolated": INTERPOLATED,
}
codecs = pytest.mark.parametrize("name", CODECS)


@functools.cache
def codec_of(name: str) -> Any:
    """(encode, decode) with random parameters, compiled."""
    config = CODECS[name]
    params = random_parameters(jax.eval_shape(lambda: initial_params(config, 0)))
    model = FieldLatentVAE(config)

    def encode(rings):
        return model.apply(params, rings, method=FieldLatentVAE.encode)

    def decode(queries, z):
        expanded = model.apply(params, z, method=FieldLatentVAE.expand)
        return model.apply(params, expanded, queries, method=FieldLatentVAE.blend)

    return jax.jit(encode), jax.jit(decode)


class Samples(NamedTuple):
    """Points of each one-ring, by face and place in it, and their colours; two thirds are encoded."""

    faces: np.ndarray  # [V, S]
    barycentrics: np.ndarray  # [V, S, 3]
    colors: np.ndarray  # [V, S, 3]


def samples_of(mesh: Triangulation, count: int = 30) -> Samples:
    rng = np.random.default_rng(8)
    faces = np.stack(
        [rng.choice(np.flatnonzero((mesh.faces == v).any(1)), count) for v in range(len(mesh.vertices))]
    )
    return Samples(faces, rng.dirichlet(np.ones(3), faces.shape), rng.uniform(size=(*faces.shape, 3)))


def there_and_back(
    name: str, mesh: Triangulation, samples: Samples
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The codes of the vertices, their deviations, and colours decoded where the encoder did not look."""
    encode, decode = codec_of(name)
    count, flat = len(mesh.vertices), samples.faces.ravel()
    logs = corner_logs(tangent_frames(mesh), mesh, flat, samples.barycentrics.reshape(-1, 3))
    logs = logs.reshape(*samples.faces.shape, 3)
    mine = (mesh.faces[samples.faces] == np.arange(count)[:, None, None]).argmax(-1)
    own = np.take_along_axis(logs, mine[..., None], -1)[..., 0]
    mean, log_sigma = encode(RingSamples(own[:, :20], samples.colors[:, :20]))
    assert mean.dtype == np.complex128
    asked = Queries(mesh.faces[samples.faces], logs, samples.barycentrics)
    asked = jax.tree.map(lambda a: jnp.asarray(a[:, 20:].reshape(-1, 3)), asked)
    return mean, log_sigma, decode(asked, mean).reshape(count, 10, 3)


def code_turn(name: str, turn: np.ndarray) -> np.ndarray:
    vectors = CODECS[name].latents - CODECS[name].invariants
    return np.where(np.arange(CODECS[name].latents) < vectors, turn[:, None], 1)


@pytest.mark.slow
@codecs
def test_codes_and_colours_see_no_motion_and_no_scale(name):
    samples = samples_of(HILL)
    here = there_and_back(name, HILL, samples)
    assert np.std(here[2]) > 1e-2
    for mesh in (moved(HILL, 1), moved(HILL, 2, 37.0)):
        for a, b in zip(there_and_back(name, mesh, samples), here, strict=True):
            assert relative(a, b) < EXACT
    stretched = Triangulation(HILL.vertices * [1, 1.1, 1], HILL.faces)
    assert relative(there_and_back(name, stretched, samples)[2], here[2]) > 1e-4


@pytest.mark.slow
@codecs
def test_codes_turn_with_the_frames_and_colours_stay(name):
    """Vertices renumbered, faces in another order and begun at another corner: other frames throughout."""
    samples, rng = samples_of(HILL), np.random.default_rng(9)
    here = there_and_back(name, HILL, samples)
    old, order = rng.permutation(COUNT), rng.permutation(len(HILL.faces))
    new = np.argsort(old)
    rolls = (np.arange(3) + rng.integers(0, 3, (len(order), 1))) % 3
    mesh = Triangulation(HILL.vertices[old], np.take_along_axis(new[HILL.faces], rolls, 1)[order])
    carried = Samples(
        np.argsort(order)[samples.faces[old]],
        np.take_along_axis(samples.barycentrics[old], rolls[samples.faces[old]], -1),
        samples.colors[old],
    )
    mean, log_sigma, colors = there_and_back(name, mesh, carried)
    before, after = tangent_frames(HILL), tangent_frames(mesh)
    place = (old[after.neighbors] == before.neighbors[old, :1]).argmax(1)
    turn = after.directions[np.arange(COUNT), place] / before.directions[old, 0]
    assert np.abs(turn - 1).max() > 0.1
    assert relative(mean, here[0][old] * code_turn(name, turn)) < EXACT
    assert relative(log_sigma, here[1][old]) < EXACT
    assert relative(colors, here[2][old]) < EXACT


@pytest.mark.slow
@codecs
def test_a_ring_sees_its_own_samples_in_any_order_and_company(name):
    encode, _ = codec_of(name)
    rng = np.random.default_rng(10)
    rings = RingSamples(noise(11, COUNT, 20), rng.uniform(size=(COUNT, 20, 3)))
    whole = encode(rings)
    order = rng.permutation(20)
    shuffled = encode(RingSamples(rings.logs[:, order], rings.colors[:, order]))
    others = encode(RingSamples(*(np.concatenate([a[:1], 3 * a[:-1]]) for a in rings)))
    for a, b, c in zip(whole, shuffled, others, strict=True):
        assert relative(b, a) < EXACT
        assert relative(c[0], a[0]) < EXACT and relative(c[1], a[1]) > 1e-3
