"""ONNX Runtime, as hiernav starts it, tells nobody: no thread, no file and no connection of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = """
import json, os, sys
from hiernav.nav.bundle import load_bundle
threads = len(os.listdir("/proc/self/task"))
from hiernav.runtime.policy import load_networks
networks = load_networks(load_bundle(sys.argv[1]))
files = [name for _, _, names in os.walk(os.environ["HOME"]) for name in names]
print(json.dumps([len(os.listdir("/proc/self/task")) - threads, files]))
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads in /proc")
def test_the_networks_run_without_telemetry(tmp_path: Path) -> None:
    # of the environment no more: where a variable tells of CI, ONNX Runtime tells nobody anyhow
    single = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = {"HOME": str(tmp_path), "PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT), **single}
    command = [sys.executable, "-c", PROGRAM, str(ROOT / "deploy" / "bundles" / "point")]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    threads, files = json.loads(done.stdout)
    assert threads == 0 and files == []
