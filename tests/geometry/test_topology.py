"""Laws of edges and marks."""

from itertools import pairwise

import numpy as np
from helpers.surfaces import random_sphere
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.arrays import mark
from flx.geometry.topology import all_of, any_of, find_edges, has_edge, topology

seeds = st.integers(0, 10**6)


@given(seeds, st.integers(4, 30))
def test_edges_are_found_by_their_ends_either_way_round(seed, count):
    rng = np.random.default_rng(seed)
    faces = random_sphere(count, seed).faces[: rng.integers(1, 2 * count - 4)]
    topo = topology(faces, count)
    joined = {frozenset(side) for face in faces.tolist() for side in pairwise([*face, face[0]])}
    assert len(topo.edges) == len(joined)
    a, b = rng.integers(0, count, (2, 200))
    expected = [frozenset(ends) in joined for ends in zip(a.tolist(), b.tolist(), strict=True)]
    np.testing.assert_array_equal(has_edge(topo, a, b), expected)
    for ends in (topo.edges, topo.edges[:, ::-1]):
        np.testing.assert_array_equal(find_edges(topo, *ends.T), np.arange(len(topo.edges)))


@given(seeds, st.integers(1, 20), st.integers(0, 12), st.integers(1, 4))
def test_a_group_has_any_or_all_of_its_members_marked(seed, count, groups, width):
    rng = np.random.default_rng(seed)
    members = rng.integers(0, count, (groups, width))
    marked = mark(count, rng.integers(0, count, rng.integers(0, count + 1)))
    np.testing.assert_array_equal(any_of(marked, members), marked[members].any(1))
    np.testing.assert_array_equal(all_of(marked, members), marked[members].all(1))
