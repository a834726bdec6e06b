"""Law of images: whatever the file holds, 8-bit RGB comes out."""

import numpy as np
import pytest
from PIL import Image

from flx.assets.formats.images import decode_image


@pytest.mark.parametrize(
    "mode, value, expected, alpha",
    [
        ("L", 77, (77, 77, 77), None),
        ("LA", (77, 5), (77, 77, 77), 5),
        ("RGBA", (1, 2, 3, 255), (1, 2, 3), None),
        ("RGBA", (1, 2, 3, 4), (1, 2, 3), 4),
        ("I;16", 257 * 200, (200, 200, 200), None),
        ("P", 0, None, None),
    ],
)
def test_every_kind_of_image_becomes_8_bit_rgb(tmp_path, mode, value, expected, alpha):
    if mode == "I;16":
        image = Image.fromarray(np.full((3, 4), value, np.uint16))
    else:
        image = Image.new(mode, (4, 3), value)
    image.save(tmp_path / "a.png")
    rgb, found = decode_image((tmp_path / "a.png").read_bytes(), "a")
    assert rgb.shape == (3, 4, 3)
    assert expected is None or (rgb == expected).all()
    assert (found is None) if alpha is None else (found == alpha).all()
