"""Laws of damage: whatever it looks like, codes, their scaling and pieces are the same."""

import numpy as np
import pytest
from helpers.surfaces import icosphere
from PIL import Image
from pipeline.test_inpainting import ASSET, HALF, SHAPE, TEXTURE
from pipeline.test_instant import BALL, SMALL

from flx.assets.asset import Asset
from flx.config import FLDM, Surface
from flx.geometry.remesh.remesh import remesh
from flx.geometry.sampling import surface_colors, transfer
from flx.geometry.tables import mesh_tables
from flx.pipeline.codec import load_codec
from flx.pipeline.instant import patch_generator
from flx.pipeline.masks import Kept, intact_masses, marked, read_damage, without_damage
from flx.training.fldm import load_copies
from flx.training.run import Run
from flx.types import SurfacePoints

BLOT = np.ones(SHAPE, bool)  # white where intact
BLOT[28:36, 20:30] = False


def repainted(asset: Asset, texels: np.ndarray) -> Asset:
    """Another picture of these texels, in a file of its own."""
    other = np.where(texels[..., None], 255 - asset.mesh.textures[0], asset.mesh.textures[0])
    return asset._replace(mesh=asset.mesh.with_layer(images=(other,)), digest="another file")


def test_the_loss_counts_the_vertices_whose_one_rings_are_intact():
    """Looked at point by point, in every face of a triangulation that is not the mesh's own."""
    copy = remesh(ASSET.mesh.vertices, ASSET.mesh.faces, 200, 1)
    masses = np.asarray(mesh_tables(copy).fine.masses)
    left = intact_masses(ASSET.mesh, Kept(TEXTURE, 0, BLOT), copy, masses)
    assert left.sum() == pytest.approx(1) and 10 < (left == 0).sum() < 60
    np.testing.assert_allclose(left[left > 0] / masses[left > 0], 1 / masses[left > 0].sum(), rtol=1e-5)
    rng, many = np.random.default_rng(0), 400
    points = SurfacePoints(np.repeat(np.arange(len(copy.faces)), many), rng.dirichlet((1, 1, 1), many * 396))
    hits = transfer(points, copy, ASSET.mesh)
    white = surface_colors(marked(ASSET.mesh, Kept(TEXTURE, 0, BLOT)), hits)[:, 0].reshape(-1, many)
    clear, hit = (white > 0.99).any(1), (white > 0.01).any(1)
    seen = np.zeros(len(masses), bool)
    seen[copy.faces[clear]] = True
    assert (left[seen] == 0).all() and seen.any()
    seen[copy.faces[hit]] = True
    assert (left[~seen] > 0).all()


def test_codes_and_their_scaling_do_not_tell_what_damage_looks_like(tmp_path):
    codec, surface = load_codec(), Surface(vertices=80, copies=2)
    found = []
    for name, asset in (("one", ASSET), ("two", repainted(ASSET, ~BLOT))):
        kept = Kept(asset.mesh.textures[0], 0, BLOT)
        rules = surface, codec, FLDM(), None, None, kept, 1
        copies, scaling, *_ = load_copies(Run(tmp_path / name), asset, *rules)
        codes, masses = copies.latents, copies.masses
        assert masses is not None and 2 < (masses == 0).sum() < 80
        found.append((codes, masses, scaling.shift, scaling.scale))
        # Of the intact vertices alone: their vectors are as large as noise.
        np.testing.assert_allclose(np.abs(codes[masses > 0])[:, :5].mean(0), np.sqrt(np.pi / 2), rtol=1e-4)
    for one, two in zip(*found, strict=True):
        np.testing.assert_array_equal(one, two)


def test_what_is_prepared_for_damage_is_not_taken_for_what_is_prepared_without():
    assert without_damage(ASSET, None) is ASSET
    digests = {without_damage(ASSET, Kept(TEXTURE, 0, white)).digest for white in (BLOT, HALF)}
    assert len(digests | {ASSET.digest}) == 3


def test_no_piece_comes_from_damage_and_damage_is_made_anew_like_the_rest():
    image = BALL.mesh.textures[0]
    white = np.zeros(image.shape[:2], bool)
    white[:, :128] = True  # the upper half of the ball is intact
    generator = patch_generator(BALL, SMALL, intact=Kept(image, 0, white))
    anchors, level = generator.sample(0), generator.synthesis.levels[-1]
    assert level.source.surface.positions[anchors.vertices][:, 2].min() > -0.15
    assert generator.held is None and generator.synthesis.free.all()


def test_masks_of_damage_that_leave_nothing_are_refused(tmp_path):
    Image.fromarray(np.full(SHAPE, 255, np.uint8)).save(tmp_path / "all.png")
    with pytest.raises(ValueError, match=r"all.png is white all over: nothing is left to learn; mark damage"):
        read_damage(tmp_path / "all.png", ASSET)
    Image.fromarray(np.zeros((7, 9), np.uint8)).save(tmp_path / "small.png")
    with pytest.raises(ValueError, match=r"has 9 × 7 pixels but the texture 96 × 64; make them equal"):
        read_damage(tmp_path / "small.png", ASSET)
    copy, spots = icosphere(1), np.zeros(SHAPE, bool)
    spots[32, 24] = True
    masses = np.asarray(mesh_tables(copy).fine.masses)
    with pytest.raises(ValueError, match="every one-ring meets damage; mark less of it, or raise --surface"):
        intact_masses(ASSET.mesh, Kept(TEXTURE, 0, spots), copy, masses)
