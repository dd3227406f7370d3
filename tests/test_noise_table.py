"""Claims about tools/noise_table.py: it drives what its rows say, and goes on where it was stopped."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "noise_table.py"
BUNDLE = str(TOOL.parents[1] / "deploy" / "bundles" / "point")


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
    assert outcome(tool.NOISE_FREE)["reached"]
    assert outcome(tool.Case(planner_ms=300))["steps"] != outcome(tool.Case())["steps"]
    assert outcome(tool.Case(filter=False, noise=4.0)) != outcome(tool.Case(noise=4.0))


def test_what_was_driven_is_not_driven_again_and_not_mixed_with_another_bundles(tool, tmp_path, monkeypatch, capsys):
    out = tmp_path / "table.json"
    done = {case.name: {"case": {}, "worlds": {"0": {
        "reached": True, "reason": "goal", "fault": None, "steps": 90, "collisions": 0, "holds": 0, "recoveries": 0,
    }}} for case in tool.cases(factorial=False)}  # fmt: skip
    files = tool.load_bundle(BUNDLE).manifest.files
    about = {"robot": "point", "bundle": files, "world": "pillar(2,2,10)", "told": True}
    out.write_text(json.dumps({"about": about, "cases": done}))
    monkeypatch.setattr(tool, "drive", lambda *_: pytest.fail("driven again"))
    monkeypatch.setattr(sys, "argv", ["noise_table.py", "--out", str(out), "--episodes", "1"])
    assert tool.main() == 0
    assert capsys.readouterr().out.count("1.000") >= 19
    monkeypatch.setattr(sys, "argv", ["noise_table.py", "--out", str(out), "--world", "gremlin", "--only-print"])
    with pytest.raises(SystemExit, match="results of another world"):
        tool.main()
