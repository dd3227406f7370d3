"""The model of another robot, or of this one as it was, is refused with exit code 3."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys

import pytest
from shipped import ROOT, RUN_LOOP, open_shipped

from hiernav.nav.bundle import BundleError


def run_loop(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(RUN_LOOP), "--fast", "--no-pictures", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


def test_the_cars_model_does_not_drive_the_point(tmp_path):
    ended = run_loop("--bundle", ROOT / "deploy" / "bundles" / "car", "--robot", "point", "--out", tmp_path / "out")
    assert ended.returncode == 3
    assert ended.stderr.strip() == "run_loop: bundle refused: robot: the bundle is for 'car', this is 'point'"
    assert not (tmp_path / "out").exists()


def test_a_model_trained_on_another_body_is_refused(tmp_path):
    bundle = shutil.copytree(ROOT / "deploy" / "bundles" / "point", tmp_path / "bundle")
    manifest = json.loads((bundle / "manifest.json").read_text())
    manifest["robot_sha256"] = "0" * 64
    (bundle / "manifest.json").write_text(json.dumps(manifest))
    ended = run_loop("--bundle", bundle, "--out", tmp_path / "out")
    assert ended.returncode == 3 and "bundle refused: robot" in ended.stderr
    with pytest.raises(BundleError, match="robot"):
        open_shipped("point").require_robot("point", "0" * 64)
