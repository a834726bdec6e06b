"""Laws of the neural field on eigenfunctions, a method to compare with."""

import numpy as np
import pytest
from helpers.subjects import rms, subject
from helpers.surfaces import icosphere

from flx.evaluation import neural_field


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


@pytest.mark.slow
def test_a_field_learns_its_mesh(monkeypatch):
    for name, value in {"STEPS": 150, "BATCH": 128, "WIDTHS": (32, 32, 3), "RATE": 1e-2}.items():
        monkeypatch.setattr(neural_field, name, value)
    seen, points, truth = subject(icosphere(2), icosphere(2))
    found = neural_field.intrinsic_field(seen)(points)
    assert rms(found, truth) < rms(truth.mean(0), truth) / 5
