"""Reward terms: pure functions of poses and of the plan that was active during the step (paper Eq. 3 and 5).

Named terms -> weights -> sum. Each term is logged by itself.
"""

from __future__ import annotations

import numpy as np

from hiernav.config import RewardConfig
from hiernav.nav import path

_MEASURES = ("preset", "lookahead_m", "division_m")
TERMS = tuple(name for name in RewardConfig.__struct_fields__ if name not in _MEASURES)
"""Names of the terms, which are the weights of `RewardConfig` in its order: a weight without a term is an error."""

_LEVEL = 0.8
"""Uprightness below which a body counts as tilted: 37 degrees, more than a sound gait sways."""


def weighted_sum(config: RewardConfig, terms: dict[str, np.ndarray]) -> np.ndarray:
    """Reward (N,): the sum of the terms, each times its weight."""
    return sum((getattr(config, name) * terms[name] for name in TERMS), start=np.zeros(len(terms["goal"])))


def reward_terms(
    config: RewardConfig,
    before: np.ndarray,
    after: np.ndarray,
    line: np.ndarray,
    goal: np.ndarray,
    collided: np.ndarray,
    reached: np.ndarray,
    left: np.ndarray,
    upright: np.ndarray,
) -> dict[str, np.ndarray]:
    """Unweighted terms of one control step, each (N,) float64.

    Args:
        before, after: (N, 2) position at both ends of the step [m].
        line: (N, K + 1, 2) plan active DURING the step, with the position it was made from in front [m].
        goal: (N, 2) [m].
        collided, reached, left: (N,) bool.
        upright: (N,) z component of the body's z axis after the step, below 0 for a robot that has turned over.
    """
    vertices = path.divide(line, config.division_m)
    return {
        "path_distance": path.path_distance(before, after, vertices, config.division_m),
        "progress": count_progress(before, after, vertices)
        if config.preset == "paper"
        else signed_progress(before, after, line, config.lookahead_m) / config.division_m,
        "collision": collided.astype(np.float64),
        "goal": reached.astype(np.float64),
        "leave_field": left.astype(np.float64),
        "tilt": np.maximum(_LEVEL - upright, 0.0),
        "fall": (upright < 0.0).astype(np.float64),
        "time": np.ones(len(before)),
        "goal_distance": np.linalg.norm(after - goal, axis=-1),
    }


def count_progress(before: np.ndarray, after: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """n_progress of the paper (N,): NNI(x_t+1) - NNI(x_t) on the divided plan (N, V, 2)."""
    index, _ = path.nearest_vertex(np.stack([before, after], axis=1), vertices)
    return (index[:, 1] - index[:, 0]).astype(np.float64)


def signed_progress(before: np.ndarray, after: np.ndarray, line: np.ndarray, lookahead: float) -> np.ndarray:
    """Progress along the plan (N,) [m], signed before its first vertex: on one plan, closed motions earn nothing."""
    ends, lines = np.concatenate([before, after]), np.concatenate([line, line])
    begin, end = path.signed_progress(ends, lines, lookahead).reshape(2, -1)
    return end - begin
