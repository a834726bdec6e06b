"""Laws of the methods that the FL-VAE is measured against: what each of them cannot lose."""

import numpy as np
import pytest
from helpers.surfaces import icosphere, square_grid
from PIL import Image
from scipy.ndimage import gaussian_filter

from flx.evaluation import baselines, neural_field
from flx.evaluation.baselines import Subject
from flx.geometry.copies import queries, sample_rings
from flx.pipeline.patches import ImagePatches
from flx.types import Layer, Queries, RingSamples, SurfacePoints, TexturedMesh, Triangulation

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
    return Subject(mesh, triangulation, rings), queries(mesh, points, triangulation), truth


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> ImagePatches:
    """Smooth coloured noise of several scales."""
    folder, rng = tmp_path_factory.mktemp("images"), np.random.default_rng(0)
    for k, scale in enumerate((2, 4, 8, 16)):
        picture = gaussian_filter(rng.normal(size=(512, 512, 3)), (scale, scale, 0))
        picture = (255 * (picture - picture.min()) / np.ptp(picture)).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{k}.png")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(baselines, "FITTED_RINGS", 1024)
        patch.setattr(baselines, "GRID", 11)
        yield baselines.open_images(folder)


def test_vertex_colours_keep_linear_and_constant_colours():
    seen, points, truth = subject(square_grid(5), square_grid(9))
    assert rms(baselines.vertex_colours(seen)(points), truth) < 1e-6 < np.ptp(truth)
    seen, points, truth = subject(icosphere(1), icosphere(2), lambda x: np.full(x.shape, 0.3))
    np.testing.assert_allclose(baselines.vertex_colours(seen)(points), truth, atol=1e-6)


@pytest.mark.parametrize("method", [baselines.components, baselines.frame_components])
def test_sixteen_components_keep_nearly_linear_colours(method, images):
    """Better than vertices can that know their rings' mean colours alone, by far."""
    seen, points, truth = subject(square_grid(5), square_grid(9))
    means = seen.rings.colors.mean(1)
    flat = np.einsum("pkc,pk->pc", means[points.vertices], points.barycentrics)
    error = rms(method(images)(seen)(points), truth)
    assert error < 0.012 and error < rms(flat, truth) / 1.3


def test_encoding_gives_back_the_coefficients_of_a_component(images):
    fitted = baselines.fit_components(images)
    seen, *_ = subject(square_grid(5), square_grid(9))
    wanted = np.random.default_rng(1).normal(size=16).astype(np.float32)
    logs = seen.rings.logs[:20]
    mean, patches = baselines._at(fitted, logs.ravel())
    rings = RingSamples(logs, np.asarray(mean + patches @ wanted, np.float32).reshape(*logs.shape, 3))
    found = np.asarray(baselines.encode_components(fitted._replace(noise=1e-6), rings))
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=2e-2)


def test_the_second_to_fourth_eigenfunctions_of_a_sphere_are_its_coordinates():
    sphere = icosphere(2)
    functions = neural_field.eigenfunctions(sphere)
    assert functions.shape == (162, 20)
    assert np.ptp(functions[:, 0]) < 1e-6 and abs(functions[0, 0]) == pytest.approx(1, abs=1e-6)
    _, left, *_ = np.linalg.lstsq(functions[:, 1:4], sphere.vertices, rcond=None)
    assert (left < 1e-3 * (sphere.vertices**2).sum(0)).all()


def test_eigenfunctions_do_not_see_how_large_a_mesh_is():
    sphere = icosphere(2)
    larger = neural_field.eigenfunctions(sphere._replace(vertices=sphere.vertices * 1000))[:, 1:4]
    _, left, *_ = np.linalg.lstsq(neural_field.eigenfunctions(sphere)[:, 1:4], larger, rcond=None)
    assert (left < 1e-6 * (larger**2).sum(0)).all()


def test_a_field_learns_its_mesh(monkeypatch):
    for name, value in {"STEPS": 150, "BATCH": 128, "WIDTHS": (32, 32, 3), "RATE": 1e-2}.items():
        monkeypatch.setattr(neural_field, name, value)
    seen, points, truth = subject(icosphere(2), icosphere(2))
    found = neural_field.intrinsic_field(seen)(points)
    assert rms(found, truth) < rms(truth.mean(0), truth) / 5
