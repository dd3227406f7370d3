"""The numbers that the paper prints (Ota et al., IROS 2020), by table."""

from __future__ import annotations

from hiernav.reproduce.experiments import TABLE3_ROBOT

TABLE2 = {1_000: 3.05, 10_000: 1.57, 50_000: 1.15, 100_000: 0.96}
"""Table II: samples -> collisions in an episode, 1000 episodes."""

TABLE3_VARIANTS = ("baseline", "ours", "finetuned")
TABLE3 = {
    "gremlin": ((0.67, 131.3), (0.99, 33.7), (1.00, 33.8)),
    "pillar(3,3,25)": ((0.78, 152.1), (0.96, 66.3), (0.97, 59.6)),
    "pillar(4,4,40)": ((0.63, 273.7), (0.97, 76.9), (0.95, 94.1)),
    "two-room": ((0.37, 397.1), (0.59, 268.4), (0.99, 59.0)),
    "four-room": ((0.67, 231.7), (0.90, 64.6), (0.98, 50.6)),
}
"""Table III: world -> reach rate and steps to the goal of each variant; of `TABLE3_ROBOT`, 200 episodes."""

TRAINING_WORLD = "pillar(2,2,10)"
"""The one that planner and skill of Table III are trained in; a fine-tuned planner also in the world of its row."""
STEPS_BETWEEN_PLANS = 8.5
"""Mean, of the rule; figure "Training curves comparison among different frequencies", the doggo."""
TRAINING_STEPS = 3_000_000
"""Environment steps of the skill that Table III drives with."""


def table3(robot: str, world: str, variant: str) -> tuple[float, float] | None:
    """Reach rate and steps that the paper prints, if it does."""
    if robot != TABLE3_ROBOT or world not in TABLE3 or variant not in TABLE3_VARIANTS:
        return None
    return TABLE3[world][TABLE3_VARIANTS.index(variant)]


def best_of_table3(world: str) -> tuple[float, float]:
    """The highest reach rate and the fewest steps in a row."""
    row = TABLE3[world]
    return max(reach for reach, _ in row), min(steps for _, steps in row)
