"""The paper's baseline: a skill that sees the goal and follows no plan, trained and measured by the same commands."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import tiny_run

from hiernav import cli
from hiernav.film import film
from hiernav.film.caption import caption

pytestmark = pytest.mark.train


def test_a_baseline_is_trained_and_measured_without_any_planner(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, report = tmp_path / "run", tmp_path / "report.json"
    settings = [text for text in tiny_run.arguments(run) if not text.startswith("skill.preset")]
    assert cli.main(["train", *settings, "skill.preset=baseline", "skill.total_steps=384"]) == 0
    assert not list(run.glob("planner*"))
    assert cli.main(["evaluate", "--run", str(run), "--episodes", "3", "--json", str(report)]) == 0
    result = json.loads(report.read_text())["pillar(2,2,10)"]
    assert (result["planner"], result["episodes"]) == ("none", 3)
    capsys.readouterr()
    titles = set()
    monkeypatch.setattr(film, "caption", lambda width, title, *more: titles.add(title) or caption(width, title, *more))
    watch = ["watch", str(run), "--world", tiny_run.WORLD, "--episodes", "1", "--size", "200", "--speed", "9"]
    assert cli.main([*watch, "--out", str(tmp_path / "film.gif")]) == 0
    assert "planner" not in capsys.readouterr().err
    (title,) = titles
    assert title.endswith("no planner, episode 1 of 1")
    assert cli.main(["export", "--run", str(run), "--onnx"]) == 2
    assert "follows no plan" in capsys.readouterr().err
    assert cli.main(["train", "--resume", str(run), "--stage", "planner"]) == 2
    assert "no planner stage" in capsys.readouterr().err
