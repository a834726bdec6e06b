"""Laws of arrays on disk: as they were written, or refused in one line."""

import ml_dtypes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import save

from flx.pipeline.tensors import load_tensors, save_tensors

TENSORS = {
    "half": np.arange(6).reshape(2, 3).astype(ml_dtypes.bfloat16),
    "key": np.array([1, 2**32 - 1], np.uint32),
    "codes": np.array([1 - 2j], np.complex64),
    "none": np.zeros((0, 4), np.float32),
    "step": np.array(7, np.int32),
}


@pytest.fixture(scope="module")
def content(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("tensors") / "a.safetensors"
    save_tensors(path, TENSORS, "kind", '{"a": 1}', {"card": "made by hand"})
    return path.read_bytes()


def read(folder, content: bytes):
    (folder / "a.safetensors").write_bytes(content)
    return load_tensors(folder / "a.safetensors", "kind")


def assert_as_written(text, tensors):
    assert text == '{"a": 1}' and tensors.keys() == TENSORS.keys()
    for name, wanted in TENSORS.items():
        assert tensors[name].dtype == wanted.dtype and tensors[name].shape == wanted.shape
        assert tensors[name].tobytes() == wanted.tobytes()


def test_arrays_of_any_type_come_back_bit_for_bit(tmp_path, content):
    assert_as_written(*read(tmp_path, content))


@given(data=st.data())
@settings(max_examples=100)
def test_a_flipped_bit_is_never_loaded(tmp_path_factory, content, data):
    """Only the card, which is not for flx to read, may change unseen."""
    flipped = bytearray(content)
    flipped[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        found = read(tmp_path_factory.mktemp("flipped"), bytes(flipped))
    except ValueError as refusal:
        assert str(refusal) and "\n" not in str(refusal)
    else:
        assert_as_written(*found)


@pytest.mark.parametrize("change", [lambda c: c[:-1], lambda c: c + b"\0", lambda c: b"", lambda c: c[:50]])
def test_a_file_of_another_length_is_refused(tmp_path, content, change):
    with pytest.raises(ValueError):
        read(tmp_path, change(content))


def test_another_kind_of_file_and_none_are_refused(tmp_path, content):
    with pytest.raises(ValueError, match="kind"):
        read(tmp_path, save(TENSORS, {"other": "x"}))
    with pytest.raises(ValueError, match="No such file"):
        load_tensors(tmp_path / "none", "kind")
