"""Law of what may be changed at once: it touches nowhere."""

import numpy as np
from helpers.surfaces import random_sphere
from hypothesis import given
from hypothesis import strategies as st

from flx.geometry.arrays import mark
from flx.geometry.remesh.operators import disjoint
from flx.geometry.remesh.stars import independent
from flx.geometry.topology import all_of, topology

seeds = st.integers(0, 10**6)


@given(seeds)
def test_groups_taken_together_touch_nowhere_and_the_first_is_among_them(seed):
    rng = np.random.default_rng(seed)
    faces = random_sphere(40, seed).faces
    priority = rng.random(len(faces))
    won = disjoint(faces, 40, priority)
    assert len(np.unique(faces[won])) == 3 * len(won) and priority.argmin() in won
    topo, asked = topology(faces, 40), rng.permutation(40)[:25]
    rank = rng.permutation(25)
    among = mark(40, asked[independent(topo, asked, rank)])
    edges = topo.edges
    assert not all_of(among, edges).any() and among[asked[rank.argmin()]]
    lower = np.full(40, 25)
    lower[asked] = rank
    lost = asked[~among[asked]]  # to a neighbour of lower rank
    assert all(lower[edges[(edges == v).any(1)]].min() < lower[v] for v in lost)
