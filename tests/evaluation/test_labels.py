"""A law of labels that are followed: where content is moved, so is the label of what it is most like."""

import numpy as np
import pytest
from helpers.generators import textured_ball
from helpers.textured import noise

from flx.evaluation import labels
from flx.evaluation.labels import labels_followed
from flx.geometry.labels import image_labels


def test_content_that_moved_has_the_label_that_it_is_most_like(monkeypatch):
    """The upper half of the ball is red, the lower blue; then the other way round, and red alone."""
    monkeypatch.setattr(labels, "BANK", (300,))
    monkeypatch.setattr(labels, "QUERIES", (200,))
    mesh = textured_ball().mesh
    grain = noise(64, 96) // 4
    left = (np.arange(96) < 48)[:, None]
    red, blue = (grain + np.array(color, np.uint8) for color in ((180, 0, 0), (0, 0, 180)))
    pictures = [np.where(left, red, blue), np.where(left, blue, red), red]
    same, swapped, all_red = (mesh.with_layer(images=(picture.astype(np.uint8),)) for picture in pictures)
    flat = [np.broadcast_to(np.where(left, a, b), (64, 96, 3)) for a, b in ((0, 200), (200, 0))]
    own, wanted = (image_labels(mesh, image.astype(np.uint8)) for image in flat)
    found = labels_followed(same, own, wanted, {"same": same, "swapped": swapped, "red": all_red})
    assert found["input"] > 0.95 and found["swapped"] > 0.95 and found["same"] < 0.05
    assert found["red"] == pytest.approx(0.5, abs=0.1)
