"""Laws of files: there whole, or not at all."""

import pytest

from flx.files import write_atomically


def test_a_file_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "new/atlas.png"
    write_atomically(path, b"first")

    def fail(torn):
        assert torn.suffix == ".png"  # some writers go by it
        torn.write_bytes(b"sec")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    assert path.read_bytes() == b"first" and len(list(path.parent.iterdir())) == 1
    write_atomically(path, lambda torn: torn.write_bytes(b"second"))
    assert path.read_bytes() == b"second" and len(list(path.parent.iterdir())) == 1


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.glb"
    path.write_bytes(b"old")
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
