"""Laws of layouts: patchworks as codes, which follow what the network follows, and end where it begins."""

import dataclasses

import numpy as np
import pytest
from helpers.generators import ball_generator
from pipeline.test_instant import BALL

from flx.controls import INVENTION, Controls, Patches
from flx.geometry.atlas import atlas_texels
from flx.geometry.patchwork.synthesis import own_places
from flx.geometry.remesh.remesh import remesh
from flx.geometry.tables import mesh_tables
from flx.pipeline.canvas import bake, open_canvas
from flx.pipeline.generator import Home
from flx.pipeline.instant import colors_from
from flx.pipeline.layout import layouts, learnt_guides, run_guides
from flx.pipeline.variations import controlled, generate, own_codes

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def begun(generator):
    return layouts(generator, generator.home.triangulation, generator.asset, Controls())


@pytest.fixture(scope="module")
def layout(begun):
    return next(begun.every([[0, 0]]))


def test_the_input_as_a_patchwork_has_the_codes_of_the_input(generator, begun, layout):
    same = begun.of(own_places(begun.patches.synthesis.levels[-1]))
    own = own_codes(generator, generator.home.triangulation)
    away, usual = (np.abs(z.codes - own).mean() for z in (same, layout))
    assert away < 0.15 * usual


def test_a_layout_depends_on_its_seed_alone(begun, layout):
    again, other = begun.every([[0, 0], [0, 1]])
    assert np.array_equal(layout.codes, again.codes) and not np.array_equal(layout.codes, other.codes)


def painted(generator, painter) -> np.ndarray:
    return bake(open_canvas(generator.asset, generator.home.triangulation), painter).colors


def test_a_layout_that_the_network_leaves_gets_its_texels_back(generator, begun, layout):
    """And one that it changes everywhere gets none."""
    texels = colors_from(begun.patches, layout.anchors, "base_color", layout.shifts)
    same = painted(generator, begun.finished(layout, layout.codes))
    np.testing.assert_allclose(same, painted(generator, texels), atol=1 / 255)
    blurred = painted(generator, generator.codec.decoder(layout.codes))
    assert np.abs(blurred - same).mean() > 2 / 255
    other = layout.codes + 100
    changed, alone = (
        painted(generator, painter)
        for painter in (begun.finished(layout, other), generator.codec.decoder(other))
    )
    far = np.abs(alone - blurred).max(1) > 0.6
    assert far.sum() > 5
    np.testing.assert_allclose(changed[far], alone[far], atol=2 / 255)


def test_the_less_is_invented_the_nearer_is_a_sample_to_its_layout(generator, begun, layout):
    """The network is untrained, so it is the start alone that knows the layout."""
    before = painted(generator, generator.codec.decoder(layout.codes))

    def made(invention: float | None) -> np.ndarray:
        return next(generate(generator, 1, steps=20, controls=Controls(invention=invention))).colors

    usual, alone = made(None), made(1.0)
    assert np.abs(usual - before).mean() < np.abs(alone - before).mean()
    np.testing.assert_array_equal(usual, made(INVENTION))


def test_other_maps_follow_the_layout(generator):
    """Roughness that is the colours comes from where the layout's colours come from."""
    base = BALL.mesh.maps["base_color"]
    mesh = BALL.mesh._replace(maps={"base_color": base, "metallic_roughness": base})
    sources = {"base_color": BALL.textures, "metallic_roughness": BALL.textures}
    own = dataclasses.replace(generator)
    own.__dict__["asset"] = BALL
    asset = BALL._replace(mesh=mesh, sources=sources)
    new = next(generate(own, 1, steps=20, asset=asset, texture_size=64))
    begun = layouts(own, own.home.triangulation, asset, Controls())
    layout = next(begun.every([[0, 0]]))
    before = bake(
        open_canvas(BALL, own.home.triangulation, 64),
        colors_from(begun.patches, layout.anchors, "base_color", 0 * layout.shifts),
    )
    shown = atlas_texels(BALL.mesh, 0, *before.images[0].shape[:2]).covered
    assert np.abs(new.maps["metallic_roughness"][0].astype(int) - before.images[0])[shown].max() <= 1
    assert np.abs(new.images[0].astype(int) - before.images[0])[shown].mean() > 2
    assert set(next(generate(own, 1, steps=20, texture_size=64)).maps) == {"base_color"}


def test_a_run_of_few_vertices_has_layouts_too(generator):
    few = remesh(generator.asset.mesh.vertices, generator.asset.mesh.faces, 60, 0)
    small = dataclasses.replace(generator, home=Home(few, mesh_tables(few)))
    begun = layouts(small, few, small.asset, Controls())
    assert next(begun.every([[0, 0]])).codes.shape == (60, 8)


def test_the_network_alone_needs_no_layout(generator):
    for how in (Controls(invention=1.0), Controls(strength=0.5)):
        assert controlled(generator, how, generator.asset).layouts is None
    assert controlled(generator, Controls(), generator.asset).layouts


def test_labels_that_were_learnt_guide_the_layout(tmp_path):
    labelled = ball_generator(tmp_path, labelled=True)
    guides = learnt_guides(labelled, labelled.asset, Controls())
    home = labelled.home.triangulation
    assert labelled.labels
    for side in guides:
        assert side.labels
        np.testing.assert_array_equal(side.labels(home), labelled.labels.numbers)
    assert learnt_guides(labelled, labelled.asset, Controls(guidance=0.0))[0].labels is None
    patches = layouts(labelled, home, labelled.asset, Controls()).patches
    anchors, (source, target) = patches.sample(0), patches.synthesis.levels[-1].characters
    assert (source.labels[anchors.vertices] == target.labels).mean() > 0.9


def test_a_direction_that_was_learnt_guides_the_layout(tmp_path):
    directed = ball_generator(tmp_path, direction="z")
    own, other = learnt_guides(directed, directed.asset, Controls(rotate=90.0))
    home = directed.home.triangulation
    assert own.direction and other.direction
    np.testing.assert_allclose(other.direction(home), 1j * own.direction(home), atol=1e-9)


def test_what_was_not_learnt_is_left_to_files(generator):
    assert run_guides(generator, generator.asset, Patches(), Controls()) is None


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"invention": 0.0}, "invention is 0.0; give more than 0 and at most 1"),
        ({"invention": float("nan")}, "invention is nan; give a number"),
        (
            {"invention": 0.3, "strength": 0.5},
            "strength is 0.5 and invention 0.3; give one: strength begins with the input, invention with "
            "pieces",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(how, message):
    with pytest.raises(ValueError) as refusal:
        Controls(**how)
    assert str(refusal.value) in (message, f"controls.{message}")
