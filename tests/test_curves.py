"""What a training can be watched by: all that is logged is a curve in TensorBoard, and what matters is logged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hiernav.nav.termination import TerminationReason
from hiernav.sim.reward import TERMS

pytestmark = pytest.mark.train
pytest.importorskip("tensorboard")

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # noqa: E402

SKILL = {
    "reach_rate", "episode_steps", "collisions_per_step", "reward_per_step", "updates", "alpha", "entropy", "q_value",
    "td_error", "loss_actor", "loss_qvalue", "loss_alpha", *(f"reward/{term}" for term in TERMS),
    *(f"replans/{reason.name.lower()}" for reason in TerminationReason if reason > TerminationReason.START),
}  # fmt: skip
PLANNER = {"loss", "error", "blocked_waypoints", "walk_collisions", "walk_reach_rate"}
EVALUATION = {"reach_rate", "steps_mean", "collisions_mean", "merit_std", "return_mean"}
RATES = {
    "skill/steps_per_second", "skill/updates_per_second", "planner/samples_per_second", "skill/seconds",
    "planner/seconds",
}  # fmt: skip


def lines(file: Path) -> list[dict]:
    return [json.loads(line) for line in file.read_text().splitlines()]


@pytest.fixture(scope="module")
def curves(trained_run: Path) -> dict[str, dict[int, float]]:
    """Tag -> step -> value, as TensorBoard reads them."""
    events = EventAccumulator(str(trained_run / "tensorboard"), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: {event.step: event.value for event in events.Scalars(tag)} for tag in events.Tags()["scalars"]}


def test_everything_worth_watching_is_a_curve(trained_run, curves):
    expected = {f"skill/{name}" for name in SKILL} | {f"planner/{name}" for name in PLANNER}
    expected |= {f"evaluation/{name}" for name in EVALUATION} | {f"rates/{name}" for name in RATES}
    last = [line for line in lines(trained_run / "metrics.jsonl") if line["stage"] == "skill"][-1]
    unknown = {f"skill/{name}" for name, value in last.items() if value is None}  # no episode has ended yet
    assert unknown <= {"skill/reach_rate", "skill/episode_steps"}
    assert curves.keys() | unknown == expected
    assert set(curves["skill/td_error"]) == {512, 768}, "no updates before learning starts"


def test_the_curves_are_what_the_metrics_file_holds(trained_run, curves):
    logged = 0
    for line in lines(trained_run / "metrics.jsonl"):
        stage, step = line.pop("stage"), line.pop("step")
        for name, value in line.items():
            if value is not None:
                assert curves[f"{stage}/{name}"][step] == pytest.approx(value, rel=1e-6)
                logged += 1
    shown = sum(len(curve) for tag, curve in curves.items() if not tag.startswith("rates/"))
    assert logged == shown > 50


def test_rates_are_kept_apart_from_what_is_the_same_for_the_same_seed(trained_run, curves):
    rates = lines(trained_run / "rates.jsonl")
    assert [(line["stage"], line["step"]) for line in rates] == [
        ("planner", 1), ("planner", 2), ("skill", 256), ("skill", 512), ("skill", 768)
    ]  # fmt: skip
    for line in rates:
        stage, step = line.pop("stage"), line.pop("step")
        for name, value in line.items():
            assert curves[f"rates/{stage}/{name}"][step] == pytest.approx(value, rel=1e-6)
            assert (value > 0.0) == ((name, step) != ("updates_per_second", 256))
    assert "per_second" not in (trained_run / "metrics.jsonl").read_text()
