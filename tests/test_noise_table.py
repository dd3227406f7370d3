"""Claims about tools/noise_table.py: it drives what its rows say, and goes on where it was stopped."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hiernav.nav.bundle import load_bundle
from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.sim.robots import get_robot

ROOT = Path(__file__).parents[1]
TOOL = ROOT / "tools" / "noise_table.py"
BUNDLES = ROOT / "deploy" / "bundles"
BUNDLE = str(BUNDLES / "point")


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("noise_table", TOOL)
    module = importlib.util.module_from_spec(spec)
    sys.modules["noise_table"] = module
    spec.loader.exec_module(module)
    return module


def test_every_influence_has_its_rows_with_the_filter_and_without(tool):
    rows = tool.cases(factorial=False)
    assert len(rows) == len(set(rows)) == 1 + 2 * (1 + 4 * 2)
    assert len(tool.cases(factorial=True)) == 1 + 3**4 * 2
    assert len({row.name for row in tool.cases(factorial=True)}) == 1 + 3**4 * 2


def test_the_same_case_gives_the_same_outcome_and_a_slow_planner_another(tool):
    def outcome(case):
        return tool.drive(case, BUNDLE, "pillar(2,2,10)", [3], told=True)["3"]

    assert outcome(tool.Case()) == outcome(tool.Case())
    assert outcome(tool.NOISE_FREE)["reached"] and outcome(tool.Case(filter=False))["reached"]
    assert outcome(tool.Case(planner_ms=300))["steps"] != outcome(tool.Case())["steps"]
    assert outcome(tool.Case(filter=False, noise=4.0)) != outcome(tool.Case(noise=4.0))


def guard_of(tool, monkeypatch, robot: str) -> GuardConfig:
    """What a drive of that robot would be guarded with."""
    driven = []

    class Stop(Exception):
        pass

    def driver(*arguments):
        driven.extend(arguments)
        raise Stop

    monkeypatch.setattr(tool, "Driver", driver)
    with pytest.raises(Stop):
        tool.drive(tool.Case(), str(BUNDLES / robot), "gremlin", [0], told=True)
    (guard,) = (each for each in driven if isinstance(each, Guard))
    return guard.config


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_a_robot_is_driven_with_the_settings_that_it_ships_with(tool, monkeypatch, robot):
    config = guard_of(tool, monkeypatch, robot)
    shipped = tool.robot_settings(get_robot(robot), ROOT / "deploy").guard
    assert (shipped.tilt_limit is None) == (robot == "point")
    bundle = load_bundle(BUNDLES / robot)
    assert config == replace(shipped, slew_limit=bundle.manifest.guard.slew_limit)
    assert config != GuardConfig(slew_limit=bundle.manifest.guard.slew_limit)


def test_a_robot_whose_own_slew_limit_is_lower_than_its_bundles_is_driven_with_that(tool, monkeypatch):
    shipped = tool.robot_settings(get_robot("point"), ROOT / "deploy")
    own = replace(shipped, guard=replace(shipped.guard, slew_limit=0.01))
    monkeypatch.setattr(tool, "robot_settings", lambda *_: own)
    assert guard_of(tool, monkeypatch, "point").slew_limit == 0.01


def test_robots_have_results_of_their_own(tool, tmp_path, monkeypatch):
    files = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tool, "_fill", lambda arguments, *_: files.append(arguments.out))
    for robot in ("point", "car"):
        monkeypatch.setattr(sys, "argv", ["noise_table.py", "--bundle", str(BUNDLES / robot)])
        assert tool.main() == 0
    assert files == [Path("runs/noise_table-point.json"), Path("runs/noise_table-car.json")]


def test_a_robot_that_stood_still_was_not_free_of_collisions(tool):
    stood = {"reached": False, "reason": "timeout", "steps": 300, "collisions": 0}
    won = {**stood, "reached": True, "reason": "goal", "steps": 90}
    found = tool._summary({"0": stood, "1": won, "2": won, "3": {**won, "collisions": 2}})
    assert found["collision_free"] == 0.5 and found["reach"] == 0.75


def test_what_was_driven_is_not_driven_again_and_not_mixed_with_another_bundles(tool, tmp_path, monkeypatch, capsys):
    out = tmp_path / "table.json"
    done = {case.name: {"case": {}, "worlds": {"0": {
        "reached": True, "reason": "goal", "fault": None, "steps": 90, "collisions": 0, "holds": 0, "recoveries": 0,
    }}} for case in tool.cases(factorial=False)}  # fmt: skip
    files = tool.load_bundle(BUNDLE).manifest.files
    settings = json.loads(json.dumps(asdict(tool.robot_settings(get_robot("point"), tool.DEPLOY))))
    settings.pop("realtime")
    about = {"robot": "point", "bundle": files, "world": "pillar(2,2,10)", "told": True, "settings": settings}
    out.write_text(json.dumps({"about": about, "cases": done}))
    monkeypatch.setattr(tool, "drive", lambda *_: pytest.fail("driven again"))
    monkeypatch.setattr(sys, "argv", ["noise_table.py", "--out", str(out), "--episodes", "1"])
    assert tool.main() == 0
    assert capsys.readouterr().out.count("1.000") >= 19
    monkeypatch.setattr(sys, "argv", ["noise_table.py", "--out", str(out), "--world", "gremlin", "--only-print"])
    with pytest.raises(SystemExit, match="results of another world"):
        tool.main()
