"""What ships in `deploy/bundles` fits the robots of this version and drives them well."""

from __future__ import annotations

from pathlib import Path

import pytest

from hiernav.evaluate import evaluate, open_policies
from hiernav.nav.bundle import load_bundle
from hiernav.runtime.policy import check_golden
from hiernav.sim.layout import parse_world

BUNDLES = sorted((Path(__file__).parents[1] / "deploy" / "bundles").iterdir())
pytestmark = pytest.mark.parametrize("path", BUNDLES, ids=lambda path: path.name)


def test_a_shipped_bundle_is_for_the_robot_it_is_named_after_and_says_where_it_comes_from(path: Path) -> None:
    policies = open_policies(path)
    manifest = load_bundle(path).manifest
    assert policies.config.robot == path.name
    assert {"seed", "skill_steps", "planner_samples", "torch"} <= set(manifest.provenance)


def test_a_shipped_bundle_gives_its_golden_outputs_and_is_small(path: Path) -> None:
    assert max(check_golden(load_bundle(path)).values()) <= 1e-5
    assert sum(file.stat().st_size for file in path.iterdir()) < 3e6


def test_a_shipped_bundle_reaches_its_goals(path: Path) -> None:
    result = evaluate(open_policies(path), [parse_world("pillar(2,2,10)")], "strict", episodes=40, seed=7)
    assert result["pillar(2,2,10)"]["reach_rate"] >= 0.9
