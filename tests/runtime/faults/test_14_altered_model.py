"""A model that is truncated or altered is never driven: exit code 3, and the robot is not even opened."""

from __future__ import annotations

import shutil

import pytest
from recorded_drive import BUNDLE
from run_loop_script import load_script

from hiernav.nav.bundle import HASHED_FILES, MANIFEST


@pytest.mark.parametrize("name", [*HASHED_FILES, MANIFEST])
@pytest.mark.parametrize("damage", ["truncated", "altered", "missing"])
def test_a_bundle_with_a_damaged_file_ends_with_exit_code_3_before_anything_moves(
    tmp_path, monkeypatch, capsys, name, damage
):
    folder = tmp_path / "bundle"
    shutil.copytree(BUNDLE, folder)
    data = bytearray((folder / name).read_bytes())
    if damage == "missing":
        (folder / name).unlink()
    elif damage == "truncated":
        (folder / name).write_bytes(data[: len(data) // 2])
    else:
        data[len(data) // 2] ^= 0x80
        (folder / name).write_bytes(data)
    script = load_script()
    monkeypatch.setattr("hiernav.runtime.sim_robot.SimRobot", lambda *_args, **_: pytest.fail("a robot was opened"))
    arguments = ["--fast", "--no-pictures", "--bundle", str(folder), "--out", str(tmp_path / "out")]
    assert script.main(arguments) == 3
    assert name in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
