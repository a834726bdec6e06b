"""Intrinsic Neural Fields (Koestler et al., ECCV 2022): one MLP per mesh, on the Laplacian's eigenfunctions.

The published budget is thousands of eigenfunctions and hours on a GPU. Ours (`EIGENFUNCTIONS`, `STEPS` and
`BATCH` below) is small enough for a table of many meshes. The MLP learns from as many colours of the texture
as the FL-VAE encodes, 64 per vertex.
"""

from typing import Any

import igl
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jaxtyping import Float, Float64
from scipy.sparse.linalg import eigsh

from flx.evaluation.baselines import Painter, Subject
from flx.geometry.sampling import ring_points, surface_colors, transfer
from flx.models.layers import RealMLP
from flx.types import Triangulation

EIGENFUNCTIONS = 512  # most eigenfunctions; never more than an eighth of the vertices
WIDTHS = (128,) * 6 + (3,)
STEPS, BATCH = 2000, 2048
RATE = 2e-3  # initial learning rate; cosine decay to 0
SAMPLES = 64  # training colours per vertex
POINTS_AT_ONCE = 32_768  # points decoded at a time


def intrinsic_field(subject: Subject) -> Painter:
    """Train an MLP from the eigenfunctions at a point to its colour."""
    functions = jnp.asarray(eigenfunctions(subject.triangulation), jnp.float32)
    rng = np.random.default_rng(0)
    points, _ = ring_points(subject.triangulation, SAMPLES, rng)
    mesh = subject.mesh
    hits = transfer(points, subject.triangulation, mesh)
    corners = jnp.asarray(subject.triangulation.faces[points.faces], jnp.int32)
    data = (corners, jnp.asarray(points.barycentrics, jnp.float32), jnp.asarray(surface_colors(mesh, hits)))
    model = RealMLP(WIDTHS)
    params = _fit(model, functions, data)

    @jax.jit
    def colors(corners: Array, barycentrics: Array) -> Array:
        def one(point: tuple[Array, Array]) -> Array:
            answer: Any = model.apply(params, point[1] @ functions[point[0]])
            return jnp.clip(0.5 + answer, 0, 1)

        return jax.lax.map(one, (corners, barycentrics), batch_size=POINTS_AT_ONCE)

    return lambda points: np.asarray(colors(jnp.asarray(points.vertices), jnp.asarray(points.barycentrics)))


def eigenfunctions(triangulation: Triangulation) -> Float64[Any, "V N"]:
    """The smoothest eigenfunctions of the cotangent Laplacian, scaled to mean square 1 over the surface.

    They include a constant for each component of the mesh.
    """
    vertices, faces = triangulation.vertices, np.ascontiguousarray(triangulation.faces, np.int64)
    count = min(EIGENFUNCTIONS, len(vertices) // 8)
    masses = igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI)
    area = masses.diagonal().sum()
    masses, stiffness = masses / area, -igl.cotmatrix(vertices, faces) / area
    # A shift just below zero keeps the matrix invertible: constants have the eigenvalue 0.
    start = np.random.default_rng(0).normal(size=len(vertices))
    return eigsh(stiffness.tocsc(), count, masses.tocsc(), sigma=-1e-2 / area, v0=start)[1]


def _fit(model: RealMLP, functions: Float[Array, "V N"], data: tuple[Array, Array, Array]) -> Any:
    """Minimise the L1 distance of colours with Adam."""
    corners, barycentrics, colors = data
    optimiser = optax.adam(optax.cosine_decay_schedule(RATE, STEPS))
    params = model.init(jax.random.key(0), functions[:1])

    def loss(params: Any, chosen: Array) -> Array:
        inputs = jnp.einsum("pk,pkn->pn", barycentrics[chosen], functions[corners[chosen]])
        answer: Any = model.apply(params, inputs)
        return jnp.mean(jnp.abs(0.5 + answer - colors[chosen]))

    def step(carry: Any, key: Array) -> tuple[Any, None]:
        params, state = carry
        chosen = jax.random.randint(key, (BATCH,), 0, len(colors))
        updates, state = optimiser.update(jax.grad(loss)(params, chosen), state)
        return (optax.apply_updates(params, updates), state), None

    train = jax.jit(lambda carry, keys: jax.lax.scan(step, carry, keys)[0])
    return train((params, optimiser.init(params)), jax.random.split(jax.random.key(1), STEPS))[0]
