"""A surface with linear colours, as the methods to compare with see it."""

import numpy as np

from flx.evaluation.baselines import Subject
from flx.geometry.copies import queries_at, sample_rings
from flx.geometry.sampling import transfer
from flx.geometry.tangent import tangent_frames
from flx.types import Layer, Queries, SurfacePoints, TexturedMesh, Triangulation

SLOPES = np.array([[0.5, -0.2, 0.1], [0.1, 0.4, -0.3], [0.2, 0.1, 0.2]])


def linear(positions: np.ndarray) -> np.ndarray:
    return 0.4 + positions @ SLOPES


def subject(
    shape: Triangulation, triangulation: Triangulation, colors=linear
) -> tuple[Subject, Queries, np.ndarray]:
    """A surface coloured at its corners, a triangulation of it, and the true colours of its points."""
    corners = shape.vertices[shape.faces]
    faces = len(shape.faces)
    none = np.zeros((faces, 3, 2))
    mesh = TexturedMesh(
        *shape,
        {"base_color": Layer((), np.zeros(faces, np.int64), none)},
        np.asarray(colors(corners), np.float32),
    )
    rng = np.random.default_rng(0)
    points = SurfacePoints(rng.integers(0, faces, 500), rng.dirichlet(np.ones(3), 500))
    truth = np.einsum("pkc,pk->pc", mesh.corner_colors[points.faces], points.barycentrics)
    rings = sample_rings(mesh, triangulation, 64, 0)
    hits = transfer(points, mesh, triangulation)
    asked = queries_at(hits, triangulation, tangent_frames(triangulation))
    return Subject(mesh, triangulation, rings), asked, truth


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))
