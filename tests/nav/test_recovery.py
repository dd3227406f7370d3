"""Recovery: when a robot counts as stuck, what is done about it, and where that ends."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from hiernav.nav.recovery import Recovery

PERIOD = 0.1
WINDOW, DURATION = 15, 6
AHEAD = np.broadcast_to([1.0, 0.0], (1, 10, 2))
PUSH = np.array([[0.5, -0.3]])


def reversing(rows: int) -> Recovery:
    """A recovery that only reverses."""
    return Recovery(rows, PERIOD, shake=0.0)


def drive(recovery: Recovery, positions: np.ndarray, plan: np.ndarray = AHEAD) -> list[bool]:
    """Whether the action was reversed, at each of the positions (T, 2)."""
    actions = [recovery(position[None], plan, PUSH) for position in np.asarray(positions, dtype=float)]
    for action in actions:
        assert_array_equal(np.abs(action), np.abs(PUSH))
    return [bool(action[0, 0] < 0) for action in actions]


def test_a_robot_that_stands_reverses_for_a_moment_and_is_then_watched_anew() -> None:
    recovery = reversing(1)
    reversed_ = drive(recovery, np.zeros((2 * (WINDOW + 1), 2)))
    begins = [t for t in range(1, len(reversed_)) if reversed_[t] and not reversed_[t - 1]]
    assert begins == [WINDOW, 2 * WINDOW + 1]
    assert sum(reversed_[: WINDOW + 10]) == DURATION
    assert recovery.counts.tolist() == [2]


def test_a_robot_on_its_way_is_left_alone() -> None:
    recovery = reversing(1)
    along = np.stack([0.004 * np.arange(200), np.zeros(200)], axis=1)
    assert not any(drive(recovery, along, AHEAD + [9.0, 0.0]))
    assert any(drive(recovery, 0.5 * along, AHEAD + [9.0, 0.0])), "half as fast it covers 3 cm in the window"


def test_a_robot_that_is_asked_to_stay_may_stand() -> None:
    recovery = reversing(1)
    assert not any(drive(recovery, np.zeros((100, 2)), np.zeros((1, 10, 2))))


def test_a_robot_whose_position_is_unknown_is_not_stuck() -> None:
    assert not any(drive(reversing(1), np.full((100, 2), np.nan)))


def test_after_three_recoveries_in_one_place_it_is_given_up() -> None:
    recovery = reversing(1)
    reversed_ = drive(recovery, np.zeros((8 * WINDOW, 2)))
    assert sum(reversed_) == 3 * DURATION
    assert recovery.given_up.tolist() == [True]
    assert recovery.counts.tolist() == [3]


def test_coming_clear_of_the_place_gives_new_tries() -> None:
    recovery = reversing(1)
    drive(recovery, np.zeros((8 * WINDOW, 2)))
    drive(recovery, np.stack([np.linspace(0.0, 0.6, 20), np.zeros(20)], axis=1), AHEAD + [1.0, 0.0])
    assert not recovery.given_up.any()
    assert sum(drive(recovery, np.full((8 * WINDOW, 2), (0.6, 0.0)), AHEAD + [1.0, 0.0])) == 3 * DURATION


def test_each_robot_is_watched_for_itself_and_a_reset_forgets() -> None:
    recovery = reversing(2)
    plan, push = np.repeat(AHEAD, 2, axis=0) + [9.0, 0.0], np.repeat(PUSH, 2, axis=0)
    turned = []
    for t in range(2 * WINDOW):
        if t == WINDOW - 1:
            recovery.reset(np.array([0]))
        action = recovery(np.array([(0.0, 0.0), (0.05 * t, 0.0)]), plan, push)
        turned.append((action[:, 0] < 0).tolist())
    assert not any(row[1] for row in turned)
    assert [row[0] for row in turned].index(True) == 2 * WINDOW - 1
    recovery.reset()
    assert not recovery.counts.any()


def test_what_the_skill_answered_is_not_written_into() -> None:
    recovery, answer = reversing(1), PUSH.copy()
    for _ in range(2 * WINDOW):
        recovery(np.zeros((1, 2)), AHEAD, answer)
    assert_array_equal(answer, PUSH)


def test_a_recovery_shakes_the_robot_anew_each_time_and_the_same_way_in_every_drive() -> None:
    still = np.zeros((1, 2))
    drives = []
    for _ in range(2):
        recovery = Recovery(1, PERIOD)
        drives.append(np.array([recovery(still, AHEAD, PUSH)[0] for _ in range(2 * (WINDOW + 1) + DURATION)]))
    assert_array_equal(*drives)
    first, second = (drives[0][t : t + DURATION] for t in (WINDOW, 2 * WINDOW + 1))
    assert (first != second).all() and (np.abs(drives[0]) <= 1.0).all()
    assert (first != -PUSH).all()
