"""Laws of the steps of remeshing: where points land, what is collapsed, flipped, measured and widened."""

from itertools import pairwise

import igl
import numpy as np
import pytest
import trimesh
from helpers.oracles import assert_sound, mean_edge
from helpers.surfaces import box, bumpy, icosphere, random_sphere, rough, square_grid, torus
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay, KDTree

from flx.geometry.arrays import area_normals, length_of
from flx.geometry.remesh import finishing
from flx.geometry.remesh.deviation import FaceQuality, MeasuredMesh, distances_to_mesh, measure_mesh
from flx.geometry.remesh.features import features
from flx.geometry.remesh.finishing import SHARP_COSINE, widen_angles
from flx.geometry.remesh.operators import collapse_edges, disjoint, flip_edges
from flx.geometry.remesh.planar import planar
from flx.geometry.remesh.smoothing import ReferenceSurface, smooth
from flx.geometry.remesh.stars import independent, sharpest_cosines
from flx.geometry.topology import (
    all_of,
    any_of,
    boundary_loops,
    edge_lengths,
    find_edges,
    has_edge,
    invariants,
    mark,
    topology,
)
from flx.types import Triangulation

seeds = st.integers(0, 10**6)
UP = np.array([0.0, 0.0, 1.0])


def pairs_of(mesh: Triangulation) -> np.ndarray:
    return topology(mesh.faces, len(mesh.vertices)).edges


# --- edges and groups


@given(seeds, st.integers(4, 30))
def test_edges_are_found_by_their_ends_either_way_round(seed, count):
    rng = np.random.default_rng(seed)
    faces = random_sphere(count, seed).faces[: rng.integers(1, 2 * count - 4)]
    topo = topology(faces, count)
    joined = {frozenset(side) for face in faces.tolist() for side in pairwise([*face, face[0]])}
    assert len(topo.edges) == len(joined)
    a, b = rng.integers(0, count, (2, 200))
    expected = [frozenset(ends) in joined for ends in zip(a.tolist(), b.tolist(), strict=True)]
    np.testing.assert_array_equal(has_edge(topo, count, a, b), expected)
    for ends in (topo.edges, topo.edges[:, ::-1]):
        np.testing.assert_array_equal(find_edges(topo, count, *ends.T), np.arange(len(topo.edges)))


@given(seeds, st.integers(1, 20), st.integers(0, 12), st.integers(1, 4))
def test_a_group_has_any_or_all_of_its_members_marked(seed, count, groups, width):
    rng = np.random.default_rng(seed)
    members = rng.integers(0, count, (groups, width))
    marked = mark(count, rng.integers(0, count, rng.integers(0, count + 1)))
    np.testing.assert_array_equal(any_of(marked, members), marked[members].any(1))
    np.testing.assert_array_equal(all_of(marked, members), marked[members].all(1))


@given(seeds)
def test_groups_taken_together_touch_nowhere_and_the_first_is_among_them(seed):
    rng = np.random.default_rng(seed)
    faces = random_sphere(40, seed).faces
    priority = rng.random(len(faces))
    won = disjoint(faces, 40, priority)
    assert len(np.unique(faces[won])) == 3 * len(won) and priority.argmin() in won
    edges, asked = topology(faces, 40).edges, rng.permutation(40)[:25]
    rank = rng.permutation(25)
    among = mark(40, asked[independent(edges, 40, asked, rank)])
    assert not all_of(among, edges).any() and among[asked[rank.argmin()]]
    lower = np.full(40, 25)
    lower[asked] = rank
    lost = asked[~among[asked]]  # to a neighbour of lower rank
    assert all(lower[edges[(edges == v).any(1)]].min() < lower[v] for v in lost)


# --- landing on a surface


def two_sheets(apart: float, length: float, face_each_other: bool, side: int = 7) -> ReferenceSurface:
    """Unit squares at heights 0 and `apart`: a wall seen from outside, or a gap seen from within."""
    points, faces = square_grid(side)
    turned = faces[:, ::-1]
    low, high = (faces, turned) if face_each_other else (turned, faces)
    vertices = np.concatenate([points, points + apart * UP])
    return ReferenceSurface(vertices, np.ascontiguousarray(np.concatenate([low, high + len(points)])), length)


@settings(max_examples=150)
@given(
    apart=st.floats(0.02, 3),
    place=st.floats(0, 1),
    upwards=st.booleans(),
    face_each_other=st.booleans(),
    x=st.floats(0.2, 0.8),
    y=st.floats(0.2, 0.8),
)
def test_a_point_lands_on_the_sheet_that_faces_its_way_within_an_edge(
    apart, place, upwards, face_each_other, x, y
):
    """Even where the other one is nearer; farther off it is not trusted."""
    length = 0.1
    apart = apart * length
    surface = two_sheets(apart, length, face_each_other)
    points = np.array([[x, y, place * apart]])
    own = apart if upwards != face_each_other else 0.0
    off = abs(points[0, 2] - own)
    assume(abs(off - length) > 1e-6 and abs(place - 0.5) > 1e-6)
    normals = (1 if upwards else -1) * UP[None]
    landed, on_own_side = surface.project(points, normals, np.zeros(1, int), np.zeros(1, bool))
    nearer = off < apart / 2
    assert on_own_side[0] == (nearer or off < length)
    height = own if on_own_side[0] else apart - own
    np.testing.assert_allclose(landed, [[x, y, height]], atol=1e-12)


@settings(max_examples=60)
@given(
    apart=st.floats(0.02, 0.95),
    place=st.floats(0, 1),
    upwards=st.booleans(),
    face_each_other=st.booleans(),
    y=st.floats(0, 1),
    aside=st.floats(-0.5, 0.5),
)
def test_a_boundary_point_lands_on_the_boundary_of_its_own_sheet(
    apart, place, upwards, face_each_other, y, aside
):
    length = 0.1
    surface = two_sheets(apart * length, length, face_each_other)
    points = np.array([[aside * length, y, place * apart * length]])
    normals = (1 if upwards else -1) * UP[None]
    inside = 0.5 * length < y < 1 - 0.5 * length  # nearest to this side of the square
    assume(inside)
    landed, on_own_side = surface.project(points, normals, np.ones(1, int), np.ones(1, bool))
    own = apart * length if upwards != face_each_other else 0.0
    np.testing.assert_allclose(landed, [[0, y, own]], atol=1e-12)
    assert on_own_side[0]


def test_a_crease_vertex_lands_on_the_crease_and_others_on_faces():
    cube = box(1.0, 1.0, 1.0)
    surface = ReferenceSurface(*cube, 0.2)
    points = np.array([[0.45, 0.47, 0.1], [0.45, 0.47, 0.1], [0.3, 0.47, 0.1]])
    normals = np.array([[0.0, 1.0, 0.0]] * 3)
    landed, on_own_side = surface.project(points, normals, np.array([1, 0, 1]), np.zeros(3, bool))
    expected = [[0.5, 0.5, 0.1], [0.45, 0.5, 0.1], [0.3, 0.5, 0.1]]  # the last is too far from any crease
    np.testing.assert_allclose(landed, expected, atol=1e-12)
    assert on_own_side.all()


def test_smoothing_stays_on_the_surface_turns_no_face_and_leaves_what_is_pinned():
    surface, mesh = bumpy(4), rough(0)
    whole = ReferenceSurface(*surface, mean_edge(mesh))
    pinned = np.random.default_rng(0).random(162) < 0.3
    smoothed = smooth(mesh, whole, 2, pinned).vertices
    np.testing.assert_array_equal(smoothed[pinned], mesh.vertices[pinned])
    assert whole.distances(smoothed[~pinned]).max() < 1e-9
    corners = smoothed[mesh.faces]
    volumes = np.linalg.det(corners)
    assert volumes.min() > 0 and (smoothed[~pinned] != mesh.vertices[~pinned]).any(1).all()


def test_no_smoothing_shrinks_a_face_to_nothing():
    """Of strewn points: faces keep a tenth of the mean area, or nearly theirs."""
    for seed in range(3):
        mesh = planar(150, (1.0, 1.0), np.random.default_rng(seed), 1.0)
        area = igl.doublearea(*mesh)
        after = smooth(mesh, ReferenceSurface(*mesh, mean_edge(mesh)), 1)
        up = area_normals(*after)[:, 2]
        assert (up >= np.minimum(0.1 * area.mean(), 0.9 * area) - 1e-12).all()
        assert np.ptp(up) < np.ptp(area)


# --- collapses


def collapse_all(mesh: Triangulation, shortest: float, longest: float, bend: float, seed: int):
    """Collapse with the memory of what was refused, until nothing is done or learnt any more."""
    rng, quiet, some = np.random.default_rng(seed), 0, 0
    refused = np.zeros((0, 2), np.int64)
    while quiet < 12:
        known = len(refused)
        mesh, done, refused = collapse_edges(mesh, shortest, longest, rng, None, bend, refused)
        some += known and done
        quiet = quiet + 1 if not done and len(refused) == known else 0
    return mesh, refused, some


def asked_alone(mesh: Triangulation, edge: np.ndarray, shortest: float, longest: float, bend: float) -> int:
    """How many edges are collapsed where all but this one are refused."""
    edges = pairs_of(mesh)
    others = edges[(edges != np.sort(edge)).any(1)]
    return collapse_edges(mesh, shortest, longest, np.random.default_rng(0), None, bend, others).done


@settings(max_examples=6)
@given(seeds)
def test_an_edge_in_memory_is_one_that_is_refused_when_asked_alone(seed):
    mesh = rough(seed)
    h = mean_edge(mesh)
    limits = (1.1 * h, 1.6 * h, 0.9)
    assert not features(*mesh, topology(mesh.faces, 162))[1].any()
    after = collapse_edges(mesh, limits[0], limits[1], np.random.default_rng(seed), None, limits[2])
    assert after.done > 3 and len(after.refused) > 3
    assert has_edge(
        topology(after.mesh.faces, len(after.mesh.vertices)), len(after.mesh.vertices), *after.refused.T
    ).all()
    assert sum(asked_alone(after.mesh, edge, *limits) for edge in after.refused) == 0


@settings(max_examples=3)
@given(seeds)
def test_collapsing_with_memory_ends_where_no_edge_can_be_collapsed(seed):
    """What is refused and then changes is asked again."""
    mesh = rough(seed)
    h = mean_edge(mesh)
    limits = (1.3 * h, 1.9 * h, 0.5)
    end, _, some = collapse_all(mesh, *limits, seed)
    assert 20 < len(end.vertices) < 120 and some > 3
    topo = topology(end.faces, len(end.vertices))
    short = topo.edges[edge_lengths(end.vertices, topo) < limits[0]]
    assert len(short) > 3 and sum(asked_alone(end, edge, *limits) for edge in short) == 0


def test_what_is_refused_is_not_asked():
    mesh = rough(0)
    after = collapse_edges(mesh, 9.0, 9.0, np.random.default_rng(0), None, -1.0, pairs_of(mesh))
    assert after.done == 0 and after.mesh.vertices.tobytes() == mesh.vertices.tobytes()
    assert collapse_edges(mesh, 9.0, 9.0, np.random.default_rng(0), None, -1.0).done > 10


@settings(max_examples=10)
@given(seeds, st.integers(0, 40))
def test_a_collapse_keeps_topology_and_bounds_and_does_as_many_as_asked(seed, most):
    open_ = planar(80, (1.0, 1.0), np.random.default_rng(seed), 0.5)
    for mesh in (rough(seed), open_):
        h = mean_edge(mesh)
        free = collapse_edges(mesh, 1.2 * h, 1.7 * h, np.random.default_rng(seed), None, 0.5)
        few = collapse_edges(mesh, 1.2 * h, 1.7 * h, np.random.default_rng(seed), most, 0.5)
        assert free.done > 2 and few.done == min(most, free.done)
        for after in (free, few):
            assert len(after.mesh.vertices) == len(mesh.vertices) - after.done
            assert invariants(*after.mesh) == invariants(*mesh)
            assert_sound(after.mesh)
            lengths = edge_lengths(after.mesh.vertices, topology(after.mesh.faces, len(after.mesh.vertices)))
            longest = edge_lengths(mesh.vertices, topology(mesh.faces, len(mesh.vertices))).max()
            assert lengths.max() <= max(longest, 1.7 * h)


def test_no_collapse_pinches_a_thin_ring():
    """Around a tube of three vertices every edge is short, and its ends have a neighbour across."""
    ring = torus(around=30, across=3, tube=0.1)
    for seed in range(3):
        after = collapse_edges(ring, 9.0, 9.0, np.random.default_rng(seed), None, -1.0)
        assert after.done > 0
        assert_sound(after.mesh)
        assert invariants(*after.mesh) == invariants(*ring)


def test_collapses_cut_no_feature():
    """Of a slab and of a square, as coarse as they get: ridges and sides are still there."""
    for mesh, size, measure, whole in (
        (box(1.0, 1.0, 0.2), 0.3, lambda m: trimesh.Trimesh(*m, process=False).volume, 0.2),
        (square_grid(12), 0.25, lambda m: igl.doublearea(*m).sum() / 2, 1.0),
    ):
        end = collapse_all(mesh, size, 3 * size, 0.3, 0)[0]
        assert len(end.vertices) < len(mesh.vertices) / 3
        assert measure(end) == pytest.approx(whole, rel=1e-12)


# --- flips


def flattened(seed: int) -> Triangulation:
    """A triangulation of a square, drawn out to three times its length: far from Delaunay."""
    points, faces = planar(150, (1.0, 1.0), np.random.default_rng(seed), 0.5)
    return Triangulation(points * np.array([3.0, 1, 1]), faces)


def opposite_angles(mesh: Triangulation) -> tuple[np.ndarray, np.ndarray]:
    """Of each inner edge: its ends, and the sum of the angles opposite to it."""
    topo = topology(mesh.faces, len(mesh.vertices))
    angles = igl.internal_angles(*mesh).ravel()
    inner = ~topo.boundary
    return topo.edges[inner], angles[topo.corners[inner]].sum(1)


@settings(max_examples=8)
@given(seeds)
def test_flips_end_where_every_edge_that_may_be_flipped_is_delaunay(seed):
    mesh = flattened(seed)
    flipped = flip_edges(mesh, np.random.default_rng(seed), delaunay=True, passes=200)
    assert_sound(flipped)
    assert (opposite_angles(mesh)[1] > np.pi + 1e-3).sum() > 20
    edges, sums = opposite_angles(flipped)
    valence = np.bincount(pairs_of(flipped).ravel())
    assert not (sums > np.pi + 1e-3)[(valence[edges] > 3).all(1)].any()


@settings(max_examples=8)
@given(seeds)
def test_each_pass_of_flips_brings_valences_nearer_to_six_and_four(seed):
    mesh = planar(150, (1.0, 1.0), np.random.default_rng(seed), 1.0)

    def excess(mesh: Triangulation) -> np.ndarray:
        topo = topology(mesh.faces, len(mesh.vertices))
        wanted = np.where(mark(150, topo.edges[topo.boundary].ravel()), 4, 6)
        return ((np.bincount(topo.edges.ravel()) - wanted) ** 2).sum()

    before = [excess(mesh)]
    for _ in range(3):
        flipped = flip_edges(mesh, np.random.default_rng(seed), delaunay=False, passes=1)
        before.append(excess(flipped))
        assert before[-1] < before[-2] or (flipped.faces == mesh.faces).all()
        mesh = flipped
        assert_sound(mesh)
    assert before[-1] < 0.8 * before[0]


def test_a_mesh_that_no_flip_makes_better_stays():
    mesh = icosphere(2)  # valences of 5 and 6
    for delaunay in (True, False):
        flipped = flip_edges(mesh, np.random.default_rng(0), delaunay=delaunay, passes=3)
        np.testing.assert_array_equal(flipped.faces, mesh.faces)


def test_no_flip_leaves_a_vertex_of_two_edges():
    """A kite with its long diagonal: Delaunay asks for the short one, which would leave two ears."""
    points = np.array([(0.0, 0, 0), (1, 0, 0), (2, 2, 0), (0, 1, 0)])
    kite = Triangulation(points, np.array([(0, 1, 2), (0, 2, 3)]))
    assert opposite_angles(kite)[1][0] > np.pi + 0.1
    flipped = flip_edges(kite, np.random.default_rng(0), delaunay=True, passes=3)
    np.testing.assert_array_equal(flipped.faces, kite.faces)


def test_no_flip_joins_who_is_joined_on_the_other_side():
    """A flat pillow, its back Delaunay and its front a fan that wants the same diagonals."""
    rng = np.random.default_rng(0)
    turn = 2 * np.pi * (np.arange(14) + 0.6 * rng.random(14)) / 14
    points = np.stack([2 * np.cos(turn), np.sin(turn), 0 * turn], 1)
    back = np.asarray(Delaunay(points[:, :2]).simplices, np.int64)[:, ::-1]
    fan = np.array([(0, k, k + 1) for k in range(1, 13)])
    pillow = Triangulation(points, np.concatenate([fan, back]))
    flipped = flip_edges(pillow, rng, delaunay=True, passes=50)
    assert_sound(flipped)
    assert invariants(*flipped) == invariants(*pillow)
    assert len({*map(frozenset, flipped.faces.tolist())} - {*map(frozenset, pillow.faces.tolist())}) > 3


@pytest.mark.parametrize("delaunay", [True, False])
def test_no_flip_crosses_a_feature(delaunay):
    """A wavy roof with a ridge of just over 60°: flips beside it may bend it less."""
    flips = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        points, faces = planar(150, (1.0, 1.0), rng, 0.3)
        points[:, 0] -= 0.5
        points[:, 0] *= 2.5
        roof = np.abs(points[:, 0]) * np.tan(np.radians(33))
        points[:, 2] = -roof + 0.03 * rng.normal(size=len(points))
        mesh = Triangulation(points, faces)
        topo = topology(faces, 150)
        held = topo.edges[features(points, faces, topo)[0]]
        flipped = flip_edges(mesh, rng, delaunay=delaunay, passes=20)
        assert len(held) > boundary_loops(topo.edges[topo.boundary], 150)
        assert has_edge(topology(flipped.faces, 150), 150, *held.T).all()
        flips += len(set(map(tuple, pairs_of(flipped))) - set(map(tuple, pairs_of(mesh))))
    assert flips > 100


# --- how far a mesh is from its surface


def lattice(n: int) -> np.ndarray:
    return np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n


def points_in(vertices: np.ndarray, faces: np.ndarray, n: int) -> np.ndarray:
    return np.einsum("pk,fkc->fpc", lattice(n), vertices[faces])


def measured(
    mesh: Triangulation, surface: Triangulation, share: float
) -> tuple[ReferenceSurface, float, MeasuredMesh]:
    whole = ReferenceSurface(*surface, mean_edge(mesh))
    gap = share * whole.length
    return whole, gap, measure_mesh(mesh, whole, gap)


@pytest.mark.parametrize(("share", "height"), [(0.2, 0.25), (0.3, 0.3), (0.42, 0.4)])
def test_faces_are_as_far_from_the_surface_as_their_points(share, height):
    """Against many points of each: what is measured is one of them, and none is much farther; what is not
    measured is within the gap."""
    mesh, surface = bumpy(2, height), bumpy(4, height)
    whole, gap, fit = measured(mesh, surface, share)
    dense = points_in(*mesh, 24)
    apart = whole.distances(dense.reshape(-1, 3)).reshape(dense.shape[:2]).max(1) / gap
    found = fit.quality.sags
    asked = found > 0
    assert asked.sum() > 20 and (~asked).sum() > 20
    assert (found <= apart + 1e-12).all() and apart[~asked].max() <= 1
    near = found > 0.7  # where a face is nearly too far off, it is measured closer
    fine = points_in(mesh.vertices, mesh.faces[near], 6)
    finer = whole.distances(fine.reshape(-1, 3)).reshape(fine.shape[:2]).max(1) / gap
    np.testing.assert_allclose(found[near], finer)
    # No point of a face is farther than this from a point of the lattice, 3 or 6 to a side.
    sides = np.array(
        [
            length_of(mesh.vertices[a] - mesh.vertices[b])
            for a, b in [mesh.faces[:, [k - 1, k]].T for k in range(3)]
        ]
    ).max(0)
    room = sides / np.where(near, 6, 3) / np.sqrt(3) / gap
    assert (apart <= found + room)[asked].all()
    np.testing.assert_array_equal(fit.wide, (found > 1) | np.isin(np.arange(320), fit.hits[fit.gaps > 1]))


def test_points_of_the_surface_are_as_far_from_the_mesh_as_from_the_face_they_hit():
    """Against the closest points of single triangles, by another library."""
    mesh, surface = bumpy(1, 0.3), bumpy(2, 0.3)
    _, gap, fit = measured(mesh, surface, 0.1)
    closest = trimesh.triangles.closest_point(mesh.vertices[mesh.faces[fit.hits]], fit.probes)
    np.testing.assert_allclose(fit.gaps * gap, length_of(closest - fit.probes), atol=1e-9)
    some = np.arange(0, len(fit.probes), 11)
    every = np.repeat(some, 80)  # against all faces
    closest = trimesh.triangles.closest_point(
        np.tile(mesh.vertices[mesh.faces], (len(some), 1, 1)), fit.probes[every]
    )
    nearest = length_of(closest - fit.probes[every]).reshape(-1, 80).min(1)
    np.testing.assert_allclose(nearest, fit.gaps[some] * gap, atol=1e-9)


@pytest.mark.parametrize(
    ("mesh", "surface", "share"),
    [
        (bumpy(1, 0.3), bumpy(2, 0.3), 0.1),
        # The corners of the coarse sphere are off by 0.6 of the gap, the middles of its faces by more than 1.
        (Triangulation(1.06 * icosphere(3).vertices, icosphere(3).faces), icosphere(1), 0.65),
    ],
)
def test_no_wide_gap_goes_unasked(mesh, surface, share):
    _, gap, fit = measured(mesh, surface, share)
    dense = points_in(*surface, 9).reshape(-1, 3)
    missed = dense[distances_to_mesh(dense, *mesh)[0] > 1.15 * gap]
    assert len(missed) > 100
    # No point of a face is farther than this from a lattice of 3 points to a side.
    room = (
        edge_lengths(surface.vertices, topology(surface.faces, len(surface.vertices))).max() / 3 / np.sqrt(3)
    )
    assert KDTree(fit.probes[fit.gaps > 1]).query(missed)[0].max() < room


@settings(max_examples=10)
@given(seeds)
def test_a_part_that_is_cut_out_and_put_back_changes_nothing(seed):
    _, gap, fit = measured(bumpy(1, 0.3), bumpy(3, 0.3), 0.1)
    rng = np.random.default_rng(seed)
    fit = fit._replace(kind=rng.integers(0, 3, 42))
    rows = np.flatnonzero(rng.random(80) < 0.4)
    whole = [a.copy() for a in (*fit.quality, *(x for x in fit if not isinstance(x, FaceQuality)))]
    part, inside, asked = fit.submesh(rows)
    np.testing.assert_array_equal(part.vertices[part.faces], fit.vertices[fit.faces[rows]])
    np.testing.assert_array_equal(part.kind, fit.kind[inside])
    np.testing.assert_array_equal(asked, np.flatnonzero(np.isin(fit.hits, rows)))
    np.testing.assert_array_equal(part.wide, fit.wide[rows])
    gaps, _ = distances_to_mesh(
        part.probes, part.vertices, part.faces
    )  # its probes are closest to its own faces
    np.testing.assert_allclose(gaps / gap, part.gaps, atol=1e-12)
    fit.vertices[inside], fit.faces[rows] = part.vertices, inside[part.faces]
    fit.quality.put(rows, part.quality)
    fit.gaps[asked], fit.hits[asked] = part.gaps, rows[part.hits]
    for new, old in zip(
        (*fit.quality, *(x for x in fit if not isinstance(x, FaceQuality))), whole, strict=True
    ):
        np.testing.assert_array_equal(new, old)


# --- wider angles


def worst_at(mesh: Triangulation) -> np.ndarray:
    """The sharpest corner's cosine in the faces around each vertex."""
    worst = np.full(len(mesh.vertices), -1.0)
    np.maximum.at(worst, mesh.faces.ravel(), sharpest_cosines(*mesh).repeat(3))
    return worst


@settings(max_examples=8)
@given(seeds)
def test_a_vertex_moves_only_where_its_sharpest_corner_widens(seed):
    mesh = random_sphere(150, seed)
    surface = ReferenceSurface(*mesh, mean_edge(mesh))
    pinned = np.random.default_rng(seed).random(150) < 0.3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(finishing, "TRIES", 1)
        patch.setattr(finishing, "MOST_TRIES", 1)
        after = widen_angles(mesh, pinned, surface, np.random.default_rng(seed))
    moved = (after.vertices != mesh.vertices).any(1)
    assert moved.sum() > 3 and not moved[pinned].any()
    before = worst_at(mesh)
    assert (worst_at(after) < before)[moved].all() and (before > SHARP_COSINE)[moved].all()
    assert not all_of(moved, pairs_of(mesh)).any()
    assert surface.distances(after.vertices).max() < 1e-12
    np.testing.assert_array_equal(after.faces, mesh.faces)


@settings(max_examples=5)
@given(seeds)
def test_angles_widen_and_corners_of_the_boundary_stay(seed):
    mesh = planar(150, (1.0, 1.0), np.random.default_rng(seed), 0.0)
    after = widen_angles(
        mesh, np.zeros(150, bool), ReferenceSurface(*mesh, mean_edge(mesh)), np.random.default_rng(seed)
    )
    before, sharp = sharpest_cosines(*mesh), sharpest_cosines(*after)
    assume(before.max() < finishing.NARROW_COSINE)  # corners give way to needles
    assert sharp.max() <= before.max() and (sharp > SHARP_COSINE).sum() < 0.7 * (before > SHARP_COSINE).sum()
    np.testing.assert_array_equal(after.vertices[:4], mesh.vertices[:4])
    assert igl.doublearea(*after).min() > 0 and igl.doublearea(*after).sum() == pytest.approx(2, rel=1e-12)
