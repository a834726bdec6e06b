"""Laws of files: there whole, or not at all."""

import errno
import os
import subprocess
import sys

import pytest

from flx.files import check_place, write_atomically


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


def test_what_killed_writers_left_is_cleared_and_what_others_write_is_not(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        ended.wait()
    left, in_use, mine = f".flx-{ended.pid}.b.npz", f".flx-{os.getppid()}.b.npz", f".{ended.pid}.notes.txt"
    for name in (left, in_use, mine, ".flx-x.b"):
        (tmp_path / name).write_bytes(b"half")
    write_atomically(tmp_path / "a.npz", b"whole")
    assert {path.name for path in tmp_path.iterdir()} == {"a.npz", in_use, mine, ".flx-x.b"}


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_said_with_the_file_and_what_to_do(tmp_path, number):
    def full(torn):
        torn.write_bytes(b"half")
        raise OSError(number, "No space left on device")  # of a write: it names no file

    with pytest.raises(OSError, match=r"disk is full: .*a\.npz was not written; make room") as error:
        write_atomically(tmp_path / "a.npz", full)
    assert error.value.errno == number and not list(tmp_path.iterdir())


def test_a_folder_in_the_place_of_a_file_is_said_and_stays(tmp_path):
    (tmp_path / "a.npz" / "mine").mkdir(parents=True)
    with pytest.raises(IsADirectoryError, match=r"a\.npz is a folder, and a file should be there; delete it"):
        write_atomically(tmp_path / "a.npz", b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"] and (tmp_path / "a.npz" / "mine").exists()


def test_the_longest_name_can_be_written(tmp_path):
    path = tmp_path / ("ä" * 125 + ".json")
    write_atomically(path, lambda torn: torn.write_bytes(torn.suffix.encode()))
    assert path.read_bytes() == b".json"


def test_what_stands_in_the_way_of_a_file_is_named_before_it_is_written(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "nowhere").symlink_to("else")
    (tmp_path / "itself").symlink_to("itself")
    (tmp_path / "there").symlink_to(tmp_path)
    for place, fault in {
        "file/a.glb": "file is a file; go",
        "file/in/a.glb": "file is a file; go",
        "nowhere/a.glb": "nowhere is a link that leads nowhere; go",
        "itself/a.glb": "Too many levels of symbolic links",
        f"{'x' * 256}/a.glb": r"… is no place for a file \(File name too long\); go",
        f"{'x/' * 4000}a.glb": r"… is no place for a file \(File name too long\); go",
    }.items():
        with pytest.raises(ValueError, match=fault):
            check_place(tmp_path / place, "go")
    for place in ("new/folder/a.glb", "there/a.glb", "nowhere", "x" * 255):
        check_place(tmp_path / place)
    assert len([*tmp_path.iterdir()]) == 4, "it makes nothing"
