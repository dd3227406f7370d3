from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shipped import ROOT

from hiernav.runtime.guard import Guard, GuardConfig
from hiernav.runtime.noise import EXACT
from hiernav.runtime.settings import load_settings
from hiernav.runtime.sim_robot import SimRobot
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import sample_layout

anything = st.floats(allow_nan=True, allow_infinity=True)
actions = st.lists(anything, min_size=3, max_size=3).map(np.array)


@pytest.mark.parametrize(
    ("own", "bundle", "both"),
    [(0.3, 0.2, 0.2), (0.1, 0.2, 0.1), (None, 0.2, 0.2), (0.3, None, 0.3), (None, None, None)],
)
def test_of_two_slew_limits_the_lower_one_holds(own, bundle, both):
    assert GuardConfig(slew_limit=own, tilt_limit=1.0).limited(bundle) == GuardConfig(slew_limit=both, tilt_limit=1.0)


@given(st.lists(st.tuples(actions, st.one_of(st.none(), anything)), max_size=40), st.booleans())
def test_whatever_comes_in_what_goes_out_is_finite_and_within_limits(sequence, slewed):
    config = GuardConfig(slew_limit=0.2 if slewed else None, tilt_limit=1.0)
    guard = Guard(3, config)
    last = np.zeros(3)
    for action, upright in sequence:
        sent = guard.check(action, upright).action
        assert np.isfinite(sent).all()
        assert (np.abs(sent) <= 1.0).all()
        if slewed and (sent != 0.0).any():
            assert (np.abs(sent - last) <= 0.2 + 1e-12).all()
        last = sent


def test_a_good_action_passes_unchanged():
    guard = Guard(2)
    verdict = guard.check(np.array([0.5, -1.0]), 1.0)
    np.testing.assert_array_equal(verdict.action, [0.5, -1.0])
    assert verdict.fault is None
    assert not guard.counts


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_action_that_is_not_finite_brakes_for_its_tick(value):
    guard = Guard(2)
    verdict = guard.check(np.array([0.5, value]))
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])
    assert verdict.fault is None
    np.testing.assert_array_equal(guard.check(np.array([0.5, 0.5])).action, [0.5, 0.5])
    assert guard.counts["non_finite"] == 1


def test_three_in_a_row_that_are_not_finite_are_a_fault():
    guard = Guard(2)
    bad, good = np.array([math.nan, 0.0]), np.zeros(2)
    assert [guard.check(action).fault is None for action in (bad, bad, good, bad, bad)] == [True] * 5
    verdict = guard.check(bad)
    assert verdict.fault is not None and "channel 0" in verdict.fault
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])


def test_an_action_beyond_the_limits_is_clipped_and_counted():
    guard = Guard(2, GuardConfig(low=-0.5, high=0.8))
    np.testing.assert_array_equal(guard.check(np.array([-3.0, 3.0])).action, [-0.5, 0.8])
    assert guard.counts["clipped"] == 1


def test_a_command_changes_no_faster_than_the_slew_limit():
    guard = Guard(1, GuardConfig(slew_limit=0.25))
    sent = [guard.check(np.array([1.0])).action[0] for _ in range(5)]
    assert sent == [0.25, 0.5, 0.75, 1.0, 1.0]
    assert guard.counts["slewed"] == 3


def test_the_brake_is_not_slewed():
    guard = Guard(1, GuardConfig(slew_limit=0.25))
    for _ in range(4):
        guard.check(np.array([1.0]))
    assert guard.check(np.array([math.nan])).action[0] == 0.0
    assert guard.check(np.array([1.0])).action[0] == 0.25


@pytest.mark.parametrize("shape", [(), (1,), (3,), (1, 2)])
def test_an_action_for_another_robot_is_a_fault(shape):
    verdict = Guard(2).check(np.zeros(shape))
    assert verdict.fault is not None and str(shape) in verdict.fault
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])


def test_a_fallen_robot_is_a_fault_after_three_ticks():
    guard = Guard(1, GuardConfig(tilt_limit=math.radians(60)))
    action = np.array([1.0])
    fallen = math.cos(math.radians(80))
    assert guard.check(action, fallen).fault is None
    assert guard.check(action, 1.0).fault is None
    assert guard.check(action, fallen).fault is None
    assert guard.check(action, math.nan).fault is None
    verdict = guard.check(action, fallen)
    assert verdict.fault == "tilted by 80 degrees, the limit is 60"
    assert verdict.action[0] == 0.0
    assert guard.counts["tilted"] == 4


def test_a_robot_that_cannot_tilt_is_not_watched_for_it():
    guard = Guard(1)
    assert all(guard.check(np.array([1.0]), -1.0).fault is None for _ in range(10))


def test_a_new_run_starts_with_a_clean_slate():
    guard = Guard(1)
    bad = np.array([math.nan])
    guard.check(bad), guard.check(bad)
    guard.reset()
    assert guard.check(bad).fault is None
    assert guard.counts["non_finite"] == 3


@pytest.mark.parametrize(
    "settings",
    [
        {"low": 0.1},
        {"high": math.inf},
        {"slew_limit": 0.0},
        {"tilt_limit": 1.6},
        {"max_non_finite": 0},
        {"max_non_finite": 21},
        {"max_tilted": 0},
        {"max_tilted": 10**9},
    ],
)
def test_limits_that_would_switch_the_guard_off_are_refused(settings):
    with pytest.raises(ValueError, match="GuardConfig"):
        GuardConfig(**settings)


def test_a_time_to_collision_that_is_not_known_stops_what_drives():
    guard = Guard(2, GuardConfig(slow_ttc=1.0, slowed=(0,)))
    np.testing.assert_array_equal(guard.check(np.array([1.0, 0.5]), ttc=math.nan).action, [0.0, 0.5])
    assert guard.counts["slowed"] == 1


DRIVE = GuardConfig(slow_ttc=1.0, saturation=0.02, drive=-math.pi / 2)
"""Of two wheels that drive the robot to its right."""


def test_a_command_that_saturates_is_slowed_from_where_it_does():
    guard = Guard(2, DRIVE)
    np.testing.assert_allclose(guard.check(np.array([1.0, 1.0]), ttc=0.25).action, 0.005)
    np.testing.assert_allclose(guard.check(np.array([0.01, 0.01]), ttc=0.5).action, 0.005)
    np.testing.assert_array_equal(guard.check(np.array([1.0, 1.0])).action, 1.0)


def test_what_brakes_is_not_slowed():
    guard = Guard(2, DRIVE)
    forward, backward = (0.0, -0.5), (0.0, 0.5)
    np.testing.assert_array_equal(guard.check(np.array([-1.0, -1.0]), ttc=0.0, velocity=forward).action, -1.0)
    np.testing.assert_allclose(guard.check(np.array([-1.0, -1.0]), ttc=0.0, velocity=backward).action, 0.0)
    np.testing.assert_allclose(guard.check(np.array([1.0, 1.0]), ttc=0.0, velocity=forward).action, 0.0)


def test_turning_is_not_slowed():
    guard = Guard(2, DRIVE)
    np.testing.assert_allclose(guard.check(np.array([1.0, -1.0]), ttc=0.0).action, [0.02, -0.02])
    np.testing.assert_allclose(guard.check(np.array([1.0, 0.0]), ttc=0.0).action, [0.01, -0.01])


@given(actions, st.floats(0.0, 1.0), st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)))
def test_slowing_leaves_the_limits(action, speed, velocity):
    config = GuardConfig(low=-0.5, high=0.5, slowed=(0, 2), drive=0.3)
    sent = Guard(3, config).check(action, speed=speed, velocity=velocity).action
    assert (np.abs(sent) <= 0.5 + 1e-12).all()


def test_after_a_brake_from_elsewhere_commands_rise_from_zero():
    guard = Guard(1, GuardConfig(slew_limit=0.1))
    for _ in range(5):
        guard.check(np.array([1.0]))
    guard.braked()
    np.testing.assert_allclose(guard.check(np.array([1.0])).action, 0.1)


@pytest.mark.parametrize(("name", "full"), [("point", 1.2), ("car", 0.6)])
def test_half_speed_is_half_the_speed_of_the_robots_that_ship(name, full):
    """Their force saturates at a few hundredths of the largest command: halving that would change nothing."""

    def speed_after(seconds: float, scale: float) -> float:
        robot = SimRobot(get_robot(name), sample_layout(parse_world("pillar(4,4,1)"), seed=1), EXACT)
        guard = Guard(2, load_settings([ROOT / "deploy" / f"{name}.yaml"]).guard)
        action = np.array([1.0, 0.0 if name == "point" else 1.0])
        for _ in range(round(seconds / robot.control_period)):
            robot.send(guard.check(action, speed=scale).action)
        return float(np.linalg.norm(robot.truth().velocity))

    at_full = speed_after(2.0, 1.0)
    assert at_full > full
    assert 0.4 * at_full < speed_after(2.0, 0.5) < 0.7 * at_full
