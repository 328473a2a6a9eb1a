"""Files are whole or absent, and what was there before survives whatever goes wrong."""

from __future__ import annotations

import errno
import hashlib
import os
import re
from pathlib import Path

import pytest

from pipeline.files import atomic_file, atomic_write, resolved, sha256_of


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def write_and_raise(path: Path, error: BaseException) -> None:
    with atomic_file(path) as file:
        file.write(b"half of the new")
        file.flush()
        raise error


@pytest.mark.parametrize("error", [ValueError("writer"), KeyboardInterrupt(), SystemExit(1)])
def test_a_writer_that_raises_leaves_the_old_content_and_nothing_else(tmp_path, error):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(type(error)):
        write_and_raise(path, error)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


def test_a_writer_that_raises_leaves_no_file_where_there_was_none(tmp_path):
    with pytest.raises(ValueError, match="writer"):
        write_and_raise(tmp_path / "a.bin", ValueError("writer"))
    assert names(tmp_path) == []


def test_the_name_shows_the_old_content_until_the_block_ends(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with atomic_file(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"old"
        (temporary,) = [n for n in names(tmp_path) if n != "a.bin"]
        assert temporary.startswith(".")
        assert temporary.endswith(".tmp")
    assert path.read_bytes() == b"new"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_failing_disk_leaves_the_old_content(tmp_path, monkeypatch, step):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def full(*_):
        raise OSError(28, "No space left on device")

    if step == "fsync":
        monkeypatch.setattr(os, "fsync", full)
    else:
        monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


def test_the_content_is_on_the_disk_before_it_gets_its_name(tmp_path, monkeypatch):
    """A rename before the flush could survive a power cut with an empty file."""
    order = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (order.append(("sync", os.fstat(fd).st_size)), fsync(fd))[1])
    monkeypatch.setattr(Path, "replace", lambda *a: (order.append(("rename", 0)), replace(*a))[1])
    atomic_write(tmp_path / "a.bin", b"12345")
    assert [what for what, _ in order] == ["sync", "rename", "sync"]  # the file, its name, the folder
    assert order[0] == ("sync", 5)


def test_content_is_whole_text_is_utf8_and_folders_are_made(tmp_path):
    content = os.urandom(3_000_001)
    path = tmp_path / "new" / "folder" / "a.bin"
    atomic_write(path, content)
    assert path.read_bytes() == content
    assert sha256_of(path) == hashlib.sha256(content).hexdigest()
    atomic_write(path, "größer\n")
    assert path.read_bytes() == b"gr\xc3\xb6\xc3\x9fer\n"


def test_an_error_of_the_disk_tells_the_file_and_not_its_temporary_one(tmp_path):
    path = tmp_path / "record.json"
    with pytest.raises(OSError, match=re.escape(f"No space left on device: {str(path)!r}")), atomic_file(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(OSError, match="elsewhere"), atomic_file(path):
        raise OSError(errno.EACCES, "no", "elsewhere")
    assert not list(tmp_path.iterdir())


def test_links_in_a_circle_stay_as_they_are(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert resolved(tmp_path / "a").parent == resolved(tmp_path)
