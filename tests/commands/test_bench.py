"""Every row of `flx bench` for the FL-VAE names what was timed, and how fast that was."""

from flx.config import FLVAE
from flx.evaluation import timings as bench
from flx.pipeline.codec import Codec, initial_params


def test_the_codec_has_its_rows(monkeypatch):
    for name, size in {"VERTICES": 40, "TEXELS": 90, "RINGS": 4, "SIDE": 16}.items():
        monkeypatch.setattr(bench, name, size)
    small = FLVAE(channels=8, layers=1, heads=2, samples=6, decoder_width=8, decoder_layers=2)
    monkeypatch.setattr(bench, "FLVAE", lambda: small)
    monkeypatch.setattr(bench, "load_codec", lambda: Codec(small, initial_params(small, 0)))
    rows = {row["name"]: row for row in bench.codec_rows(repeats=1)}
    assert list(rows) == [
        "product/float32",
        "product/bfloat16",
        "encode/40",
        "decode/90",
        "transformer_forward/4",
        "transformer_gradient/4",
    ]
    for name, row in rows.items():
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
