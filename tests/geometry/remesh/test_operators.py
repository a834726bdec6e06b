"""Laws of collapses and flips: what is done, what is refused, what is never asked twice."""

import igl
import numpy as np
import pytest
import trimesh
from helpers.oracles import assert_sound, mean_edge, pairs_of
from helpers.surfaces import box, icosphere, rough, square_grid, torus
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from flx.geometry.arrays import mark
from flx.geometry.remesh.features import features
from flx.geometry.remesh.operators import collapse_edges, flip_edges
from flx.geometry.remesh.planar import planar
from flx.geometry.topology import (
    boundary_loops,
    edge_lengths,
    has_edge,
    invariants,
    topology,
)
from flx.types import Triangulation

seeds = st.integers(0, 10**6)


# --- edges and groups


# --- landing on a surface


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
    assert has_edge(topology(after.mesh.faces, len(after.mesh.vertices)), *after.refused.T).all()
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
        assert has_edge(topology(flipped.faces, 150), *held.T).all()
        flips += len(set(map(tuple, pairs_of(flipped))) - set(map(tuple, pairs_of(mesh))))
    assert flips > 100


# --- how far a mesh is from its surface


# --- wider angles
