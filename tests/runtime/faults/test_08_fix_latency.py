"""Position fixes that come up to 80 ms late, in another order than they were measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import FIX_SIGMA, Errors, Motion, estimator_for, follow, frames, recorded

from hiernav.runtime.robot import SensorFrame


def reordered(motion: Motion, seed: int) -> list[SensorFrame]:
    """The motion's frames with a fix at every stamp, each delivered 0 to 80 ms after it was measured."""
    rng = np.random.default_rng(seed)
    plain = list(frames(motion, seed))
    arrivals: dict[int, list[tuple[float, np.ndarray]]] = {}
    for k, stamp in enumerate(motion.stamps):
        late = int(np.searchsorted(motion.stamps, stamp + (rng.uniform(0.0, 0.08) if k else 0.0) - 1e-9))
        fix = motion.poses[k, :2] + FIX_SIGMA * rng.standard_normal(2)
        arrivals.setdefault(late, []).append((float(stamp), fix))
    result = []
    for k, frame in enumerate(plain):
        arrived = arrivals.get(k, [(None, None)])
        stamp, fix = arrived[rng.integers(len(arrived))]
        result.append(replace(frame, position_fix=fix, fix_stamp=stamp))
    return result


@pytest.mark.parametrize("seed", range(3))
def test_late_and_reordered_fixes_are_used_where_the_robot_was(seed):
    motion = recorded("point")  # the only one whose control period is short enough for fixes to overtake each other
    stream = reordered(motion, seed)
    stamps = [frame.fix_stamp for frame in stream if frame.fix_stamp is not None]
    assert any(later < earlier for earlier, later in zip(stamps, stamps[1:], strict=False))
    estimator = estimator_for(motion)
    errors = follow(motion, estimator, iter(stream))
    naive: Errors = follow(motion, estimator_for(motion), (replace(frame, fix_stamp=frame.stamp) for frame in stream))
    assert estimator.counts["stale_fix"] > 0
    assert errors.position_rms < FIX_SIGMA
    assert errors.position_rms < naive.position_rms


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("latency", [0.0, 0.04, 0.08])
def test_a_constant_latency_does_not_matter(robot, latency):
    motion = recorded(robot)
    nominal = follow(motion, estimator_for(motion), frames(motion))
    late = follow(motion, estimator_for(motion), frames(motion, latency=latency))
    assert late.position_rms < 1.5 * nominal.position_rms
