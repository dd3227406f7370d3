"""A bundle whose skill was trained on another observation is refused, and the field is named."""

from __future__ import annotations

import json
import shutil

import pytest
from recorded_drive import BUNDLE
from run_loop_script import load_script

from hiernav.nav.bundle import MANIFEST


def wrong_unit(terms):
    terms[2]["unit"] = "deg/s"


def wrong_size(terms):
    terms[4]["size"] = 16


def wrong_order(terms):
    terms[0], terms[1] = terms[1], terms[0]


def wrong_scale(terms):
    terms[5]["scale"] = 1.0


def one_less(terms):
    terms.pop()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (wrong_unit, "observation[2] 'gyro': unit is 'deg/s' in the bundle"),
        (wrong_size, "observation[4] 'lidar': size is 16 in the bundle, 10 on this robot"),
        (wrong_order, "observation[0] 'velocimeter': name"),
        (wrong_scale, "observation[5] 'waypoints': scale"),
        (one_less, "observation[5] 'waypoints': it exists only on this robot"),
    ],
)
def test_another_observation_is_refused_by_field(tmp_path, capsys, change, field):
    folder = tmp_path / "bundle"
    shutil.copytree(BUNDLE, folder)
    manifest = json.loads((folder / MANIFEST).read_text())
    change(manifest["observation"])
    (folder / MANIFEST).write_text(json.dumps(manifest))
    assert load_script().main(["--fast", "--bundle", str(folder), "--out", str(tmp_path / "out")]) == 3
    assert field in capsys.readouterr().err
