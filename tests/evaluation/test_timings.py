"""Every row of `flx bench` for the FL-VAE names what was timed, and how fast that was."""

import os
import time

import pytest

from flx.config import FLVAE
from flx.evaluation import timings
from flx.pipeline.codec import Codec, initial_params

WARM_UP, ENCODE, DECODE = 1000.0, 2.0, 9.0  # seconds


@pytest.fixture(scope="module")
def rows() -> dict[str, dict]:
    """Of a codec that takes as long as above, on a clock that is put forward."""
    small = FLVAE(channels=8, layers=1, heads=2, samples=6, decoder_width=8, decoder_layers=2)
    clock, skipped, calls = time.perf_counter, [0.0], {"encode": 0, "decode": 0}

    def slow(name: str, seconds: float):
        def call(self, *arguments):
            skipped[0] += seconds if calls[name] else WARM_UP
            calls[name] += 1
            return getattr(Codec, name)(self, *arguments)

        return call

    class Slow(Codec):
        encode, decode = slow("encode", ENCODE), slow("decode", DECODE)

    with pytest.MonkeyPatch.context() as patch:
        for name, size in {"VERTICES": 40, "TEXELS": 90, "RINGS": 4, "SIDE": 16}.items():
            patch.setattr(timings, name, size)
        patch.setattr(timings, "FLVAE", lambda: small)
        patch.setattr(timings, "load_codec", lambda: Slow(small, initial_params(small, 0)))
        patch.setattr(time, "perf_counter", lambda: clock() + skipped[0])
        return {row["name"]: row for row in timings.codec_rows(repeats=2)} | {"calls": calls}


@pytest.mark.slow
def test_the_codec_has_its_rows(rows):
    assert list(rows)[:-1] == [
        "product/float32",
        "product/bfloat16",
        "encode/40",
        "decode/90",
        "transformer_forward/4",
        "transformer_gradient/4",
    ]
    for name, row in list(rows.items())[:-1]:
        assert row["seconds"] > 0
        kind, count = name.split("/")
        if kind == "product":
            assert abs(row["gflops"] * row["seconds"] - 2e-9 * 16**3) < 1e-12
        else:
            assert abs(row["per_second"] - int(count) / row["seconds"]) <= 0.5
    forward, gradient = (
        rows[f"transformer_{name}/4"]["gflops"] * rows[f"transformer_{name}/4"]["seconds"]
        for name in ("forward", "gradient")
    )
    assert gradient > 1.5 * forward > 0
    assert rows["decode/90"]["peak_bytes"] >= rows["encode/40"]["peak_bytes"] > 1e7


@pytest.mark.slow
def test_seconds_are_those_of_a_call_after_the_first_by_the_clock(rows):
    assert rows["calls"] == {"encode": 3, "decode": 3}
    for name, seconds, count in (("encode/40", ENCODE, 40), ("decode/90", DECODE, 90)):
        assert seconds <= rows[name]["seconds"] < seconds + 1
        assert count / (seconds + 1) - 1 < rows[name]["per_second"] <= count / seconds


def test_the_peak_is_in_bytes_and_of_this_process():
    page = os.sysconf("SC_PAGE_SIZE")
    with open("/proc/self/statm") as file:
        held = int(file.read().split()[1]) * page
    assert 0.9 * held < timings.peak_bytes() < os.sysconf("SC_PHYS_PAGES") * page
