"""What a dry run finds wrong with a robot before anything moves."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from puck import Puck
from recorded_drive import BUNDLE
from rich.console import Console

from hiernav.nav.bundle import load_bundle
from hiernav.runtime import dry_run
from hiernav.runtime.guard import GuardConfig
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.settings import Settings


class Still(Puck):
    """A robot that is braked, and whose time goes on."""

    realtime: dict[str, str] = {}
    slow: str | None = None

    def trouble(self) -> str | None:
        return self.slow

    def read(self) -> SensorFrame:
        self.brake()
        return super().read()


def found_of(monkeypatch, sees, settings: Settings | None = None) -> dict[str, object]:
    return report_of(monkeypatch, sees, settings)["robot"]


def report_of(monkeypatch, sees, settings: Settings | None = None) -> dict[str, dict[str, object]]:
    monkeypatch.setattr(dry_run, "WAKES", 1)
    monkeypatch.setattr(dry_run, "LOOK", 0.2)
    monkeypatch.setattr(dry_run, "PATIENCE", 0.5)
    robot = Still(control_period=0.02, sees=sees)
    return dry_run.report(lambda: load_bundle(BUNDLE), lambda: robot, settings or Settings())


@pytest.mark.parametrize(
    ("readings", "error"),
    [
        ({}, None),
        ({"position_fix": np.zeros(3)}, "position_fix has 3 values, 2 are expected"),
        ({"gyro": np.zeros(1), "lidar": np.zeros(360)}, "gyro has 1 values, 3 are expected, lidar has 360"),
        ({"rotation": np.zeros(9)}, "rotation has 9 values, 4 are expected"),
        ({"extra": {"joint_sin": np.zeros(12)}}, None),
        ({"gyro": None, "position_fix": None}, " s: position_fix, gyro"),
        ({"velocimeter": np.full(3, np.nan)}, "never finite: velocimeter"),
        ({"lidar": np.full(10, 3.0)}, "lidar reads 3 to 3, closeness in [0, 1] is expected"),
        ({"stamp": np.nan}, "stamps do not advance: nan to nan s"),
        ({"stamp": 7.0}, "stamps do not advance: 7 to 7 s"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_sensor_is_an_error_that_names_it(monkeypatch, readings, error):
    found = found_of(monkeypatch, lambda frame: replace(frame, **readings))
    assert found["control period"] == "20 ms"
    assert ("error" in found) == (error is not None) and (error or "") in found.get("error", "")


def test_a_robot_that_keeps_commands_waiting_is_an_error(monkeypatch):
    monkeypatch.setattr(Still, "slow", "the adapter keeps commands waiting for 0.12 s")
    assert "keeps commands waiting for 0.12 s" in found_of(monkeypatch, lambda frame: frame)["error"]


def test_a_sensor_that_speaks_seldom_is_not_silent(monkeypatch):
    def sees(frame: SensorFrame) -> SensorFrame:
        return frame if round(50.0 * frame.stamp) % 5 == 3 else replace(frame, position_fix=None)

    found = found_of(monkeypatch, sees)
    assert "error" not in found and "position_fix" in found["sensors"]


def test_settings_that_the_guard_refuses_are_found_before_anything_moves(monkeypatch):
    settings = replace(Settings(), guard=GuardConfig(slowed=(7,)))
    assert "actuators are 0 to 1" in found_of(monkeypatch, lambda frame: frame, settings)["error"]


def test_it_tells_how_the_networks_were_trained(monkeypatch):
    found = report_of(monkeypatch, lambda frame: frame)["bundle"]
    assert found["trained"].startswith("hiernav 0.1.0, torch 2.13.0, seed 0, skill_steps 100000")


def test_texts_of_a_bundle_are_shown_as_they_are():
    told = {"trained": "settings [red]run_dir=[/x]\x1b[2J\n", "[b]extra": "y " * dry_run.SHOWN}
    screen = Console(file=io.StringIO(), width=200)
    dry_run.print_report({"bundle": told}, screen)
    shown = screen.file.getvalue()
    assert "settings [red]run_dir=[/x]\N{REPLACEMENT CHARACTER}[2J" in shown and "[b]extra" in shown
    assert "\x1b" not in shown and shown.count("y") == dry_run.SHOWN // 2
