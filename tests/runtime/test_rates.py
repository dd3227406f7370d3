"""The point robot's loop at several rates, measured on this machine with planner and robot in their processes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

BENCH = Path(__file__).parents[2] / "tools" / "bench_loop.py"


def measured(tmp_path: Path, rate: int, seconds: float, hogs: int = 0) -> dict[str, Any]:
    out = tmp_path / "loop.json"
    settings = ["--rate", str(rate), "--seconds", str(seconds), "--hogs", str(hogs), "--json", str(out)]
    subprocess.run([sys.executable, str(BENCH), *settings], check=True, timeout=300, cwd=BENCH.parents[1])
    return json.loads(out.read_text())[0]


@pytest.mark.realtime
@pytest.mark.parametrize("rate", [50, 100])
def test_an_idle_machine_keeps_its_deadlines(tmp_path, rate):
    found = measured(tmp_path, rate, 60.0)
    assert found["missed"] <= 0.001 and found["lateness"]["p99"] <= 0.002
    assert abs(found["phase_drift"]) < 1e-6 and found["ticks_to_brake"] <= 2


@pytest.mark.realtime
def test_two_programs_that_compute_beside_it_cost_few_deadlines(tmp_path):
    assert measured(tmp_path, 50, 60.0, hogs=2)["missed"] <= 0.02


@pytest.mark.realtime
def test_the_skill_sustains_500_hz(tmp_path):
    found = measured(tmp_path, 500, 10.0)
    assert found["tick"]["p99"] < 0.002 and found["missed"] <= 0.01


@pytest.mark.realtime
def test_a_control_process_stays_small(tmp_path):
    assert measured(tmp_path, 50, 10.0)["resident"] < 150.0
