"""Laws of joints: faces and texels are joined over seams, where the surface is, and nowhere else."""

import numpy as np
from helpers.slab import BOARD, SIDE, slab, texel_places
from helpers.surfaces import both, icosphere, square_grid, torus
from helpers.textured import noise, quad, separate_charts, textured

from flx.geometry.atlas import atlas_texels, fill_gutter
from flx.geometry.joints import bridges, followers, joints_of, similar
from flx.types import Triangulation


def test_neighbours_share_an_edge_and_point_back_at_each_other():
    mesh = textured(torus(), np.zeros((576, 3, 2)), noise(4, 4))
    joints = joints_of(mesh)
    corners = np.arange(joints.across.size).reshape(-1, 3)
    assert (joints.across >= 0).all() and (joints.across.ravel()[joints.across] == corners).all()
    for k in range(3):
        ends = np.sort(joints.places[:, [k - 2, k - 1]], 1)
        there = joints.across[:, k]
        others = np.stack([there - there % 3 + (there + n) % 3 for n in (1, 2)], 1)
        assert (np.sort(joints.places.ravel()[others], 1) == ends).all()


def test_faces_are_joined_by_place_and_charts_by_coordinates():
    """Vertices that a file split at a seam are one place; charts end there, parts do not."""
    joints = joints_of(slab().mesh)
    assert (joints.across >= 0).all() and joints.parts.max() == 0 and joints.charts.max() == 6
    ball = icosphere(1)
    alone = joints_of(textured(ball, separate_charts(ball, 9), noise(4, 4)))
    assert len(np.unique(alone.charts)) == len(ball.faces) and not alone.smooth.any()
    two = joints_of(textured(both(ball, ball), np.zeros((160, 3, 2)), noise(4, 4)))
    assert two.parts.max() == 1 and (two.parts[:80] == 0).all() and two.smooth.all()
    sheet = joints_of(textured(square_grid(3), np.zeros((8, 3, 2)), noise(4, 4)))
    assert (sheet.across < 0).sum() == 8
    split = Triangulation(
        sheet_corners := square_grid(3).vertices[square_grid(3).faces].reshape(-1, 3),
        np.arange(len(sheet_corners)).reshape(-1, 3),
    )
    again = joints_of(textured(split, np.zeros((8, 3, 2)), noise(4, 4)))
    assert (again.across == sheet.across).all()


def test_an_edge_of_three_faces_joins_them_in_a_circle():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1.0)])
    fan = Triangulation(vertices, np.array([(0, 1, 2), (1, 0, 3), (0, 1, 4)]))
    joints = joints_of(textured(fan, np.zeros((3, 3, 2)), noise(4, 4)))
    found, face = {0}, 0
    for _ in range(2):
        face = next(int(corner) // 3 for corner in joints.across[face] if corner >= 0)
        found.add(face)
    assert found == {0, 1, 2} and joints.parts.max() == 0


def test_followers_show_what_the_gutter_will_be():
    mesh = slab().mesh
    atlas = atlas_texels(mesh, 0, 90, 110)
    image = noise(90, 110)
    chains, shown = followers(atlas).ravel(), image.reshape(-1, 3).copy()
    lengths = []
    for texel in atlas.texels:
        follower, count = chains[texel], 0
        while follower >= 0:
            assert not atlas.covered.ravel()[follower]
            shown[follower] = image.reshape(-1, 3)[texel]
            follower, count = chains[follower], count + 1
        lengths.append(count)
    assert (shown.reshape(image.shape) == fill_gutter(image, atlas.covered, reach=1.5)).all()
    assert max(lengths) > 1 and (shown != image.reshape(-1, 3)).any(1).sum() > 500


def test_bridges_join_texels_that_are_near_on_the_surface():
    asset = slab()
    places, atlas = texel_places(asset)
    everywhere = np.full((SIDE * SIDE, 3), np.nan)
    everywhere[atlas.texels] = places
    joints = joints_of(asset.mesh)
    one, other = bridges(asset.mesh, joints, atlas)
    assert len(one) > 500 and np.linalg.norm(everywhere[one] - everywhere[other], axis=1).max() < 0.06
    charts = joints.charts[atlas.faces.ravel()]
    assert (charts[one] != charts[other]).all()
    whole = quad([(0, 0), (1, 0), (1, 1), (0, 1)])
    assert not len(bridges(whole, joints_of(whole), atlas_texels(whole, 0, 8, 8))[0])


def test_a_colour_spreads_over_seams_and_not_to_another_place_like_it():
    asset = slab()
    places, atlas = texel_places(asset)
    joints, image = joints_of(asset.mesh), asset.mesh.textures[0].copy()
    disc = (image != BOARD).any(2)
    back = atlas.texels[(places[:, 2] < -0.014) & (np.hypot(places[:, 0], places[:, 1]) < 0.2)]
    image.reshape(-1, 3)[back] = image[disc][0]  # the same colour, elsewhere
    start = int(np.flatnonzero(disc)[0])
    bridged = bridges(asset.mesh, joints, atlas)
    found = similar(image, atlas, joints.charts, bridged, start, 0.1)
    assert (found == disc).all() and set(joints.charts[atlas.faces[found]]) == set(
        joints.charts[atlas.faces[disc]]
    )
    assert len(set(joints.charts[atlas.faces[disc]])) == 2
    none = np.zeros(0, np.int64)
    half = similar(image, atlas, joints.charts, (none, none), start, 0.1)
    assert 0.4 < half.sum() / disc.sum() < 0.6
    assert (similar(image, atlas, joints.charts, bridged, start, 1.0) == atlas.covered).all()
