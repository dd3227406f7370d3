from __future__ import annotations

import os
from pathlib import Path

import pytest

from hiernav import files
from hiernav.files import write_atomically, write_json


def test_a_file_is_written_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    file = tmp_path / "checkpoint.pt"
    write_atomically(file, b"old")
    synced: list[bytes] = []

    def fail(source, target):
        synced.append(Path(source).read_bytes())
        raise OSError("power cut")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="power cut"):
        patch.setattr(files.os, "replace", fail)
        write_atomically(file, b"new and longer")
    assert file.read_bytes() == b"old" and os.listdir(tmp_path) == ["checkpoint.pt"]
    assert synced == [b"new and longer"]  # complete, on disk, before it takes the old one's place
    write_atomically(file, b"newest")
    assert file.read_bytes() == b"newest"
    assert os.listdir(tmp_path) == ["checkpoint.pt"]


def test_json_brings_its_folder_with_it(tmp_path):
    file = tmp_path / "new" / "figures.json"
    write_json(file, {"rate": 0.5})
    assert file.read_text() == '{\n  "rate": 0.5\n}\n'


def test_a_link_stays_a_link_and_a_pipe_a_pipe(tmp_path):
    target, link, pipe = (tmp_path / name for name in ("target", "link", "pipe"))
    target.write_bytes(b"old")
    link.symlink_to(target)
    write_atomically(link, b"new")
    assert link.is_symlink() and target.read_bytes() == b"new"
    os.mkfifo(pipe)
    reading = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_atomically(pipe, b"new")
    assert os.read(reading, 10) == b"new" and pipe.is_fifo()
    os.close(reading)
