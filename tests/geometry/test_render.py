"""Laws of the z-buffer pictures."""

import numpy as np
import pytest

from flx.geometry.render import ENCODED, LINEAR, contact_sheet, render
from flx.types import Layer, TexturedMesh

RED, GREEN, BLUE = (np.array(c, np.uint8) for c in ((220, 30, 30), (30, 200, 30), (30, 30, 220)))


def squares(*heights: float, textures: tuple = ()) -> TexturedMesh:
    """Unit squares in planes z = height that face +z, each with its own texture, v down."""
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1.0)])
    uvs = np.array([(0, 1), (1, 1), (1, 0), (0, 0.0)])
    pair = np.array([(0, 1, 2), (0, 2, 3)])
    vertices = np.concatenate([np.column_stack([corner, np.full(4, z)]) for z in heights])
    faces = np.concatenate([pair + 4 * n for n in range(len(heights))])
    layer = Layer(textures, np.repeat(np.arange(len(heights)), 2), np.tile(uvs[pair], (len(heights), 1, 1)))
    return TexturedMesh(vertices, faces, {"base_color": layer}, np.zeros((len(faces), 3, 3), np.float32))


def plain(color: np.ndarray) -> np.ndarray:
    return np.broadcast_to(color, (4, 4, 3)).copy()


def hue(pixel: np.ndarray) -> int:
    return int(pixel.astype(int).argmax())


@pytest.mark.parametrize("azimuth, expected", [(0, 1), (180, 0)])
def test_the_nearer_square_hides_the_farther(azimuth, expected):
    mesh = squares(-0.1, 0.1, textures=(plain(RED), plain(GREEN)))
    picture = render(mesh, azimuth=azimuth, elevation=0, size=64)
    middle = picture[20:44, 20:44].reshape(-1, 3).astype(int)
    assert (middle.argmax(1) == expected).all()
    # ... wherever it stands in the list of faces
    turned = mesh._replace(faces=mesh.faces[[2, 3, 0, 1]]).with_layer(
        face_images=mesh.face_textures[[2, 3, 0, 1]]
    )
    np.testing.assert_array_equal(render(turned, azimuth=azimuth, elevation=0, size=64), picture)


def test_crossing_squares_are_cut_where_they_cross():
    mesh = squares(0, 0, textures=(plain(RED), plain(GREEN)))
    vertices = mesh.vertices.copy()
    vertices[:4, 2], vertices[4:, 2] = vertices[:4, 0], -vertices[4:, 0]
    picture = render(mesh._replace(vertices=vertices), azimuth=0, elevation=0, size=65)
    assert hue(picture[32, 26]) == 1 and hue(picture[32, 38]) == 0


def quarters() -> np.ndarray:
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4], image[:4, 4:], image[4:, :4], image[4:, 4:] = RED, GREEN, BLUE, (200, 200, 200)
    return image


def test_a_texture_stands_upright_and_is_not_mirrored():
    picture = render(squares(0, textures=(quarters(),)), azimuth=0, elevation=0, size=64)
    assert [hue(picture[y, x]) for y, x in ((24, 24), (24, 40), (40, 24))] == [0, 1, 2]
    assert np.ptp(picture[40, 40].astype(int)) < 4


def test_z_up_shows_what_y_up_shows_of_the_turned_mesh():
    mesh = squares(-0.4, 0.2, textures=(plain(RED), quarters()))
    mesh = mesh._replace(vertices=mesh.vertices * np.repeat([1, 0.6], 4)[:, None])
    turned = mesh._replace(vertices=mesh.vertices[:, [0, 2, 1]] * [1, -1, 1])
    for azimuth, elevation in ((0, 0), (40, 25), (-70, 60)):
        views = [
            render(m, azimuth=azimuth, elevation=elevation, size=48, up=up)
            for m, up in ((mesh, "y"), (turned, "z"))
        ]
        assert np.ptp(views[0]) > 50
        assert np.abs(views[0].astype(int) - views[1]).mean() < 0.1


def test_a_growing_azimuth_walks_round_to_the_right():
    mesh = squares(0, textures=(plain(RED),))
    picture = render(mesh, azimuth=50, elevation=0, size=96, supersample=1)
    # From the right, the right edge is nearer, so it looks taller.
    lit = (picture[..., 0].astype(int) - picture[..., 1]) > 60
    tall = lit.sum(0)
    columns = np.flatnonzero(tall)
    assert tall[columns[-3]] > tall[columns[2]] + 3


def test_perspective_does_not_bend_texture_lines():
    stripes = np.zeros((1, 64, 3), np.uint8)
    stripes[:, 32:] = 255
    mesh = squares(0, textures=(stripes,))
    picture = render(mesh, azimuth=0, elevation=65, size=128).astype(int)[..., 1]
    rows = [y for y in range(128) if (picture[y] < 60).sum() > 10]
    # The middle line of the square projects to the middle column, on every row.
    edges = [np.flatnonzero(picture[y] < 60).max() for y in rows]
    assert len(rows) > 20 and max(edges) - min(edges) <= 1


def test_edges_are_smoothed_and_the_scale_of_views_is_one():
    mesh = squares(0, textures=(plain(RED),))
    few = np.unique(render(mesh, azimuth=20, elevation=10, size=64, supersample=1).reshape(-1, 3), axis=0)
    many = np.unique(render(mesh, azimuth=20, elevation=10, size=64, supersample=3).reshape(-1, 3), axis=0)
    assert len(many) > len(few)
    for azimuth in range(10, 360, 50):  # the whole mesh is inside: the frame stays background
        picture = render(mesh, azimuth=azimuth, elevation=35, size=64)
        frame = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert len(np.unique(frame, axis=0)) == 1
        assert (picture != picture[0, 0]).any(-1).sum() > 100


def test_given_textures_are_shown_instead():
    mesh = squares(0, textures=(plain(RED),))
    assert hue(render(mesh, [plain(BLUE)], azimuth=0, elevation=0, size=32)[16, 16]) == 2
    assert hue(render(mesh, azimuth=0, elevation=0, size=32)[16, 16]) == 0
    with pytest.raises(ValueError, match="2 textures for a mesh that has 1"):
        render(mesh, [plain(BLUE)] * 2)


def test_a_face_towards_the_lamp_is_brighter_than_one_turned_away():
    mesh = squares(0, textures=(plain(np.full(3, 150, np.uint8)),))
    views = [render(mesh, azimuth=a, elevation=0, size=64)[32, 32, 0] for a in (0, -75)]
    assert 60 < views[1] < views[0] - 20 < 150


def test_linear_light_and_back_is_the_same_colour():
    levels = np.arange(256)
    steps = np.rint(LINEAR[np.rint(levels / 255 * 4095).astype(int)] * 4095).astype(int)
    assert np.abs(ENCODED[steps].astype(int) - levels).max() <= 2
    assert ENCODED[0] == 0 and ENCODED[-1] == 255


def test_a_contact_sheet_holds_every_picture_whole():
    rows = [[np.full((20, 30, 3), 10 * (3 * y + x), np.uint8) for x in range(3)] for y in range(2)]
    sheet = contact_sheet(rows)
    assert sheet.shape == (2 * 32 + 12, 3 * 42 + 12, 3)
    for n in range(6):
        top, left = 12 + n // 3 * 32, 12 + n % 3 * 42
        assert (sheet[top : top + 20, left : left + 30] == 10 * n).all()
    captioned = contact_sheet(rows, ["input", "one", "two"])
    assert captioned.shape[0] > sheet.shape[0] and captioned.shape[1] == sheet.shape[1]
    assert captioned[:24].min() < 120  # letters
    with pytest.raises(ValueError, match="1 captions for 3 columns"):
        contact_sheet(rows, ["input"])
