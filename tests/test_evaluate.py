"""Claims about evaluation: honest counting, the same episodes for the same seed, from a run as from its bundle."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_run

from hiernav.config import TrainConfig, load_config
from hiernav.evaluate import (
    EPISODES,
    Policies,
    episode_seeds,
    evaluate,
    evaluate_plans,
    fingerprints,
    make_planner,
    open_policies,
    summarize,
    wilson_interval,
)
from hiernav.nav.bundle import MANIFEST, BundleError
from hiernav.nav.planners import GoseloPlanner, ShortestPathPlanner, VerifiedPlanner
from hiernav.nav.termination import TerminationReason
from hiernav.run import RunError
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.rollout import Episode

POINT_BUNDLE = Path(__file__).parents[1] / "deploy" / "bundles" / "point"
WORLD = parse_world(tiny_run.WORLD)
REASONS = [reason.name.lower() for reason in TerminationReason if reason]


def turn_and_drive(observation: np.ndarray) -> np.ndarray:
    """A skill whose rows are computed apart, to the last bit: turns to the fifth waypoint, drives when it is ahead."""
    first = get_robot("point").observation_layout().slices["waypoints"].start + 8
    ahead, left = observation[:, first], observation[:, first + 1]
    return np.stack([np.clip(10.0 * ahead - 4.0 * np.abs(left), -1.0, 1.0), np.clip(8.0 * left, -1.0, 1.0)], axis=-1)


def policies_of(**changes: object) -> Policies:
    config: TrainConfig = load_config(None, ["robot=point", f"skill.worlds=['{tiny_run.WORLD}']"])
    return replace(Policies(config, turn_and_drive, None), **changes)  # type: ignore[arg-type]


def episode(**changes: object) -> Episode:
    values: dict[str, object] = {
        "seed": 0, "reached": True, "reason": "goal", "steps": 40, "cap": 300, "collisions": 0, "return_": 1.0,
        "path_length": 2.0, "shortest_length": 1.0, "replans": dict.fromkeys(REASONS, 1), "refused": 0,
        "recoveries": 1,
    }  # fmt: skip
    return Episode(**(values | changes))  # type: ignore[arg-type]


def without_clock(results: dict[str, dict]) -> dict[str, dict]:
    return {world: {key: v for key, v in row.items() if key != "seconds"} for world, row in results.items()}


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.2775),  # Brown, Cai and DasGupta 2001
        (10, 10, 0.7225, 1.0),
        (8, 10, 0.4902, 0.9433),
        (81, 263, 0.2553, 0.3662),  # Newcombe 1998, table I
        (15, 148, 0.0624, 0.1605),
        (1, 29, 0.0061, 0.1718),
        (994, 1000, 0.9870, 0.9972),
    ],
)
def test_the_wilson_interval_has_the_published_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=6e-5)


def test_an_interval_of_nothing_is_refused():
    with pytest.raises(ValueError, match="trials must be at least 1, got 0"):
        wilson_interval(0, 0)


def test_a_summary_counts_every_episode_once():
    done = [
        episode(steps=40, collisions=0, path_length=2.0, shortest_length=1.0),
        episode(steps=60, collisions=3, path_length=0.9, shortest_length=1.0, refused=2),
        episode(reached=False, reason="left_field", steps=10, collisions=1, return_=-1.0),
        episode(reached=False, reason="timeout", steps=300, replans=dict.fromkeys(REASONS, 0) | {"half_index": 7}),
    ]
    summary = summarize(done)
    assert summary["episodes"] == 4
    assert summary["reach_rate"] == 0.5
    assert summary["reach_ci95"] == list(wilson_interval(2, 4))
    assert summary["steps_mean"] == (40 + 60 + 300 + 300) / 4  # a failure counts the cap, however early it came
    assert summary["collisions_mean"] == 1.0
    assert summary["collision_free_rate"] == 0.25  # reached AND untouched: the timeout without contact is none
    assert summary["spl_mean"] == pytest.approx((0.5 + 1.0 + 0.0 + 0.0) / 4)
    assert summary["spl_unknown"] == 0
    assert summary["return_mean"] == 0.5
    assert summary["endings"] == {"goal": 2, "left_field": 1, "timeout": 1}
    assert summary["replans"] == dict.fromkeys(REASONS, 3) | {"half_index": 10}
    assert (summary["refused"], summary["recoveries"]) == (2, 4)


def test_episodes_without_a_shortest_path_are_counted_and_left_out_of_spl():
    unknown, half = episode(shortest_length=float("nan")), episode(path_length=2.0, shortest_length=1.0)
    failed = episode(reached=False, reason="timeout", shortest_length=float("nan"))
    some, none = summarize([unknown, half, failed, unknown]), summarize([unknown])
    assert (some["spl_mean"], some["spl_unknown"]) == (pytest.approx((0.5 + 0.0) / 2), 2)
    assert (none["spl_mean"], none["spl_unknown"]) == (None, 1)


def test_a_return_by_a_reward_that_is_not_known_is_none():
    assert summarize([episode()], knows_reward=False) == summarize([episode()]) | {"return_mean": None}
    for known in (True, False):
        row = evaluate(policies_of(knows_reward=known), [WORLD], planner="astar", episodes=2)[tiny_run.WORLD]
        assert (row["return_mean"] is not None) == known


@pytest.mark.parametrize("recover", [True, False])
@pytest.mark.parametrize(("guidance", "planner"), [("default", "astar"), ("baseline", "none")])
def test_a_row_says_what_helped(guidance: str, planner: str, recover: bool):
    settings = ["robot=point", f"skill.preset={guidance}", "option.period=9", "option.invalid=false"]
    policies = policies_of(
        config=load_config(None, settings), skill=lambda observation: np.zeros((len(observation), 2))
    )
    row = evaluate(policies, [WORLD], planner="astar", episodes=1, recover=recover, predict=not recover)[tiny_run.WORLD]
    assert (row["planner"], row["repair"], row["period"], row["invalid"]) == (planner, False, 9, False)
    assert row["recover"] is (recover and guidance == "default")
    assert row["predict"] is (not recover and guidance == "default")
    for repair in (True, False):
        walked = evaluate_plans(policies, WORLD, "astar", repair, episodes=2)
        assert (walked["planner"], walked["repair"]) == (planner, False)


@pytest.mark.train
def test_a_fine_tuning_of_a_bundle_does_not_know_its_reward_either(able_run: Path, able_bundle: Path, tmp_path: Path):
    from hiernav.finetune import begin_fine_tuning, fine_tuning_config

    for source, known in ((able_run, True), (able_bundle, False)):
        for folder in (tmp_path / f"{known}", tmp_path / f"{known}-again"):
            begin_fine_tuning(fine_tuning_config(source, [f"run_dir={folder}"]), source).close()
            assert open_policies(folder).knows_reward == known
            source = folder


def test_the_seeds_of_a_short_evaluation_are_the_first_of_a_long_one():
    np.testing.assert_array_equal(episode_seeds(5, 1000)[:20], episode_seeds(5, 20))
    assert len(np.unique(episode_seeds(5, 1000))) == 1000
    assert not np.array_equal(episode_seeds(6, 20), episode_seeds(5, 20))


def test_one_world_gives_one_object_with_every_metric():
    results = evaluate(policies_of(), [WORLD, parse_world("two-room")], planner="astar", episodes=4, rows=4)
    assert list(results) == [tiny_run.WORLD, "two-room"]
    for name, row in results.items():
        assert row["world"] == name
        assert (row["robot"], row["protocol"], row["planner"], row["seed"]) == ("point", "strict", "astar", 0)
        assert row["episodes"] == 4
        low, high = row["reach_ci95"]
        assert 0.0 <= low <= row["reach_rate"] <= high <= 1.0 and low < high
        assert row["collision_free_rate"] <= row["reach_rate"]
        assert 0.0 <= row["spl_mean"] <= row["reach_rate"]
        assert row["collisions_mean"] >= 0.0 and row["steps_mean"] > 1.0
        assert list(row["replans"]) == REASONS
        assert row["replans"]["start"] == 4
        assert sum(row["endings"].values()) == 4


def test_a_robot_that_follows_the_expert_arrives_by_a_short_way():
    row = evaluate(policies_of(), [WORLD], planner="astar", episodes=12)[tiny_run.WORLD]
    assert row["reach_rate"] == 1.0 and row["endings"] == {"goal": 12}
    assert 10 < row["steps_mean"] < 120
    assert row["spl_mean"] > 0.7
    still = policies_of(skill=lambda observation: np.zeros((len(observation), 2)))
    row = evaluate(still, [WORLD], planner="astar", episodes=3)[tiny_run.WORLD]
    assert row["reach_rate"] == 0.0 and row["steps_mean"] == WORLD.max_steps and row["spl_mean"] == 0.0


@pytest.mark.parametrize("world", [tiny_run.WORLD, "gremlin(1.5,1.5,3)"])
def test_the_same_seed_gives_the_same_episodes_however_many_run_side_by_side(world):
    spec, kept = parse_world(world), {}
    for rows in (64, 5, 1):
        episodes: dict[int, Episode] = {}

        def keep(_, index, done, episodes=episodes):
            episodes[index] = done

        results = evaluate(policies_of(), [spec], planner="astar", episodes=8, seed=2, rows=rows, on_episode=keep)
        kept[rows] = (without_clock(results), [episodes[index] for index in range(8)])
    assert kept[64] == kept[5] == kept[1]
    assert len({e.steps for e in kept[1][1]}) > 2
    other = evaluate(policies_of(), [spec], planner="astar", episodes=8, seed=3)
    assert without_clock(other) != kept[64][0]


def test_contacts_with_gremlins_count_under_the_strict_protocol_alone():
    """Robots that drive on whatever comes hit gremlins and pillars alike."""
    into = parse_world("gremlin(1.5,1.5,4)")

    def charge(observation: np.ndarray) -> np.ndarray:
        return np.tile([1.0, 0.1], (len(observation), 1))

    counts = {}
    for protocol in ("paper", "strict"):
        for world in (into, parse_world("pillar(1.2,1.2,2)")):
            row = evaluate(policies_of(skill=charge), [world], protocol, "astar", episodes=6)[str(world)]
            counts[protocol, world.kind] = row["collisions_mean"]
    assert counts["strict", "gremlin"] > 0.0 == counts["paper", "gremlin"]
    assert counts["strict", "pillar"] == counts["paper", "pillar"] > 0.0


def test_each_protocol_has_its_number_of_episodes(monkeypatch):
    driven: list[int] = []

    def drive(task, skill, layouts, on_episode, recover):
        driven.append(len(layouts))
        return [episode() for _ in layouts]

    monkeypatch.setattr("hiernav.evaluate.run_episodes", drive)
    for protocol in ("paper", "strict"):
        row = evaluate(policies_of(), [parse_world("pillar(1.2,1.2,0)")], protocol, "astar", rows=2)
        assert row["pillar(1.2,1.2,0)"]["episodes"] == EPISODES[protocol]
    assert driven == [200, 1000]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"protocol": "loose"}, "unknown protocol 'loose'; known: paper, strict"),
        ({"planner": "rrt"}, "unknown planner 'rrt'; known: cnn, astar"),
        ({"planner": "cnn"}, "hold no planner network: train the planner first, or use --planner astar"),
        ({"episodes": 0}, "episodes must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate(policies_of(), [WORLD], **({"planner": "astar", "episodes": 1} | arguments))


def test_a_folder_that_is_neither_run_nor_bundle_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"neither a run folder .*config\.yaml.* nor a bundle .*manifest\.json"):
        open_policies(tmp_path)
    with pytest.raises(BundleError, match="no such folder"):
        open_policies(tmp_path / "absent")


def test_a_bundle_is_driven_by_the_rule_and_the_plans_that_its_manifest_says(tmp_path):
    shutil.copytree(POINT_BUNDLE, tmp_path / "bundle")
    manifest = json.loads((tmp_path / "bundle" / MANIFEST).read_text())
    manifest["replan"] |= {"d_update_m": 0.41, "half_fraction": 0.7, "invalid": False, "period": 16}
    manifest["plan"] |= {"planning_radius_m": 0.13, "soft_margin_m": 0.07, "spacing_m": 0.1}
    (tmp_path / "bundle" / MANIFEST).write_text(json.dumps(manifest))
    policies = open_policies(tmp_path / "bundle")
    option = policies.config.option
    assert (option.d_update_m, option.half_fraction, option.invalid, option.period) == (0.41, 0.7, False, 16)
    expert = make_planner(policies, "astar")
    assert isinstance(expert, ShortestPathPlanner) and (expert.radius, expert.soft_margin) == (0.13, 0.07)
    verified = make_planner(policies, "cnn")
    assert isinstance(verified, VerifiedPlanner) and isinstance(verified.planner, GoseloPlanner)
    assert (verified.radius, verified.repair.radius) == (0.1, 0.13), "checked for the robot, repaired as it was taught"
    assert (verified.planner.radius, verified.planner.margin) == (0.13, 0.07)


@pytest.mark.train
def test_a_run_without_a_trained_skill_is_refused_with_a_hint(tmp_path):
    from hiernav.run import Run

    run = Run.create(tiny_run.config(tmp_path / "run"))
    with pytest.raises(RunError, match=f"no trained skill yet: go on with `hiernav train --resume {run.path}`"):
        open_policies(run.path)


@pytest.mark.train
def test_the_network_plans_verified_or_alone(able_run: Path):
    policies = open_policies(able_run)
    verified = make_planner(policies, "cnn")
    assert isinstance(verified, VerifiedPlanner) and isinstance(verified.planner, GoseloPlanner)
    assert verified.radius == 0.1
    assert isinstance(make_planner(policies, "cnn", repair=False), GoseloPlanner)
    assert isinstance(make_planner(policies, "astar"), ShortestPathPlanner)
    dense = parse_world("pillar(1.5,1.5,8)")
    checked, alone = (evaluate(policies, [dense], episodes=6, repair=repair)[str(dense)] for repair in (True, False))
    assert checked["proposals"] >= checked["repairs"] > 0
    assert checked["proposals"] >= sum(checked["replans"].values()) - checked["replans"]["goal"]
    assert "proposals" not in alone
    assert (checked["planner"], checked["repair"], checked["recover"]) == ("cnn", True, True)
    assert (alone["planner"], alone["repair"]) == ("cnn", False)


@pytest.mark.train
def test_plans_are_walked_along_verified_or_alone(able_run: Path):
    policies, dense, told = open_policies(able_run), parse_world("pillar(1.5,1.5,8)"), []
    checked = evaluate_plans(policies, dense, episodes=120, on_episodes=told.append)
    alone, expert = (evaluate_plans(policies, dense, kind, False, episodes=120) for kind in ("cnn", "astar"))
    assert told == [100, 120]
    assert checked["collisions_total"] == expert["collisions_total"] == 0 < alone["collisions_total"]
    assert checked["repairs"] > 0 and "repairs" not in alone
    assert [row["repair"] for row in (checked, alone, expert)] == [True, False, False]
    assert checked["reach_rate"] == expert["reach_rate"] == 1.0
    assert alone["collisions_mean"] == alone["collisions_total"] / 120


@pytest.mark.train
@pytest.mark.parametrize("planner", ["cnn", "astar"])
def test_a_run_and_its_bundle_drive_the_same_episodes(able_run: Path, able_bundle: Path, planner):
    """Differences of a millionth between the two libraries may choose another plan now and then, no other outcome."""
    driven = {}
    for source in (able_run, able_bundle):
        episodes: dict[int, Episode] = {}

        def keep(_, index, done, episodes=episodes):
            episodes[index] = done

        row = evaluate(open_policies(source), [WORLD], planner=planner, episodes=12, on_episode=keep)[str(WORLD)]
        driven[source] = (
            row["reach_rate"],
            [row[name] for name in ("planner", "repair", "recover", "predict", "period", "invalid", "spl_unknown")],
            [(episodes[k].seed, episodes[k].reached) for k in range(12)],
            np.array([episodes[k].steps for k in range(12)]),
        )
        assert row["replans"]["start"] == 12
        assert (row["return_mean"] is None) == (source is able_bundle)
    *ours, steps = driven[able_run]
    *theirs, other_steps = driven[able_bundle]
    assert ours == theirs
    assert np.count_nonzero(steps != other_steps) <= 2 and np.abs(steps - other_steps).max() <= 3
    assert open_policies(able_bundle).config.option == open_policies(able_run).config.option


@pytest.mark.train
def test_a_bundle_for_another_model_of_the_robot_is_refused(able_bundle: Path, monkeypatch):
    monkeypatch.setattr("hiernav.evaluate.file_sha256", lambda path: "0" * 64)
    with pytest.raises(BundleError, match="robot_sha256: the model of 'point' has changed since training"):
        open_policies(able_bundle)


@pytest.mark.parametrize(
    ("field", "wrong", "message"),
    [
        ("control_period_s", 0.04, "control_period_s: 0.04 s in the bundle, 0.02 s on this robot"),
        ("map_resolution_m", 0.1, "map_resolution_m: 0.1 m in the bundle, 0.05 m in the runtime"),
        ("plan", None, "plan.waypoints: 10 in the network, 9 in the manifest"),
    ],
)
def test_a_bundle_that_assumes_another_rate_map_or_plan_is_not_measured(tmp_path: Path, field, wrong, message):
    folder = Path(shutil.copytree(POINT_BUNDLE, tmp_path / "bundle"))
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest[field] = manifest[field] | {"waypoints": 9} if wrong is None else wrong
    (folder / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(BundleError, match=message):
        open_policies(folder)


def test_a_bundle_with_another_number_of_actions_is_not_measured(monkeypatch):
    monkeypatch.setattr("hiernav.evaluate.get_robot", lambda name: replace(get_robot(name), action_dim=3))
    with pytest.raises(BundleError, match="actions: 2 in the bundle, 3 on this robot"):
        open_policies(POINT_BUNDLE)


@pytest.mark.train
def test_the_policies_of_a_run_are_known_by_their_files(trained_run):
    names = ("planner/checkpoint.pt", "skill/checkpoint.pt", "config.yaml")
    assert fingerprints(trained_run) == {
        name: hashlib.sha256((trained_run / name).read_bytes()).hexdigest() for name in names
    }
