"""A skill that asks for all the actuators can give, 90 % of the time for 2 s, is helped; in vain, it is a fault."""

from __future__ import annotations

import numpy as np
import pytest
from puck import Listener, Puck, driver_of, follow, pilot_for

from hiernav.nav.planners import StraightPlanner
from hiernav.runtime.supervisor import Mode

FAR = np.array([1.9, 1.9])
PERIOD = 0.02


def drive(share: float, lasting: float, turning: float) -> tuple[Listener, object]:
    """Circles at full command in a share of the ticks, for some time [s], at `turning` [rad/s]."""
    calls = iter(range(10**9))

    def skill(observations: np.ndarray) -> np.ndarray:
        k = next(calls)
        if k * PERIOD > lasting:
            return follow(observations)
        sign = np.sign([np.cos(turning * k * PERIOD), np.sin(turning * (k + 0.5) * PERIOD)])
        return (sign if (k * share) % 1.0 < share else 0.9 * sign).astype(np.float32)[None]

    seen = Listener()
    pilot = pilot_for(StraightPlanner(), skill=skill, period=PERIOD)
    driver = driver_of(
        Puck(noise=1e-3, control_period=PERIOD, position=np.array([-1.0, -1.0])), pilot, observers=[seen]
    )
    return seen, driver.run(FAR, max_steps=3000)


def test_a_saturated_skill_is_helped_after_two_seconds():
    seen, result = drive(share=1.0, lasting=2.2, turning=1.0)
    begun = next(record for record in seen.records if record.mode is Mode.RECOVERING)
    assert begun.time == pytest.approx(2.0, abs=3 * PERIOD)
    way, yaw = begun.plan - begun.estimate.pose[:2], begun.estimate.pose[2]
    np.testing.assert_allclose(way @ [-np.sin(yaw), np.cos(yaw)], 0.0, atol=1e-9, err_msg="straight ahead or back")
    assert result.reached and result.recoveries >= 1


def test_less_than_nine_tenths_are_no_reason():
    seen, result = drive(share=0.8, lasting=2.5, turning=0.5)
    assert result.reached and result.recoveries == 0


def test_recoveries_that_do_not_help_end_in_a_fault():
    seen, result = drive(share=1.0, lasting=1e9, turning=12.0)
    assert result.reason == "fault" and "recoveries in this place did not help" in result.fault
    assert result.recoveries >= 3


def test_so_do_those_that_are_never_twice_in_one_place():
    seen, result = drive(share=1.0, lasting=1e9, turning=2.0)
    assert result.reason == "fault" and "stays saturated, 3 recoveries did not help" in result.fault
