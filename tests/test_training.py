"""Both stages, from a program."""

from __future__ import annotations

import pytest
import tiny_run

pytest.importorskip("torch")

from hiernav.evaluate import evaluate, open_policies
from hiernav.run import Run
from hiernav.sim.layout import parse_world
from hiernav.training import train

pytestmark = pytest.mark.train


def test_a_program_trains_and_evaluates_without_a_word(tmp_path, capfd, monkeypatch):
    run = Run.create(tiny_run.config(tmp_path / "run", "skill.total_steps=512", "skill.eval_every_steps=512"))
    commits = iter(("first", "second"))  # somebody commits while it trains
    monkeypatch.setattr("hiernav.training.package_state", lambda: (next(commits), False))
    train(run)
    run.close()
    assert run.codes() == ["first"]
    (result,) = evaluate(open_policies(run.path), [parse_world(tiny_run.WORLD)], episodes=2).values()
    assert result["episodes"] == 2
    assert capfd.readouterr().out == ""
