"""A network whose weights lie in another file, reached by `../`, is refused before anything is read from there."""

from __future__ import annotations

import hashlib
import json
import shutil

import pytest
from shipped import ROOT
from test_16_other_robot import run_loop

onnx = pytest.importorskip("onnx")


@pytest.mark.parametrize("location", ["../secret.bin", "/etc/passwd", "weights.bin"])
def test_a_network_with_external_data_is_refused(tmp_path, location):
    bundle = shutil.copytree(ROOT / "deploy" / "bundles" / "point", tmp_path / "bundle")
    (tmp_path / "secret.bin").write_bytes(bytes(1 << 16))
    model = onnx.load(str(bundle / "skill.onnx"))
    weight = model.graph.initializer[0]
    weight.data_location = onnx.TensorProto.EXTERNAL
    weight.ClearField("raw_data")
    for key, value in (("location", location), ("offset", "0"), ("length", "1024")):
        weight.external_data.add(key=key, value=value)
    data = model.SerializeToString()
    (bundle / "skill.onnx").write_bytes(data)
    manifest = (bundle / "manifest.json").read_text()
    before = hashlib.sha256((ROOT / "deploy" / "bundles" / "point" / "skill.onnx").read_bytes()).hexdigest()
    assert before in manifest
    (bundle / "manifest.json").write_text(manifest.replace(before, hashlib.sha256(data).hexdigest()))
    json.loads((bundle / "manifest.json").read_text())
    ended = run_loop("--bundle", bundle, "--out", tmp_path / "out")
    assert ended.returncode == 3
    assert "skill.onnx" in ended.stderr and "external" in ended.stderr
