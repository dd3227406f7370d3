"""Spikes of 10 to 1000 sigma on 5 % of all samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from runtime_motion import FIX_SIGMA, SIGMA, estimator_for, follow, frames, recorded

from hiernav.runtime.estimator import Trust
from hiernav.runtime.robot import SensorFrame


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
@pytest.mark.parametrize("seed", range(6))
def test_spikes_are_gated_and_the_position_error_at_most_doubles(robot, seed):
    motion = recorded(robot)
    rng = np.random.default_rng([seed, 4])
    spikes = 0

    def spike(reading: np.ndarray | None, sigma: float) -> np.ndarray | None:
        nonlocal spikes
        if reading is None or rng.random() > 0.05:
            return reading
        spikes += 1
        return reading + sigma * 10.0 ** rng.uniform(1.0, 3.0) * rng.choice([-1.0, 1.0], len(reading))

    def damage(frame: SensorFrame) -> SensorFrame:
        values = {name: spike(getattr(frame, name), sigma) for name, sigma in SIGMA.items()}
        return replace(frame, **values, position_fix=spike(frame.position_fix, FIX_SIGMA))

    nominal = follow(motion, estimator_for(motion), frames(motion, seed))
    estimator = estimator_for(motion)
    spiked = follow(motion, estimator, frames(motion, seed), damage)
    assert spikes > 20
    assert sum(count for name, count in estimator.counts.items() if name.endswith("_rejected")) > 0
    assert spiked.position_rms <= 2.0 * nominal.position_rms
    assert all(estimate.trust is Trust.GOOD for estimate in spiked.estimates)
