"""Recovery: when a robot counts as stuck, what is done about it, and where that ends."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.occupancy import OccupancyMap, draw_boxes, draw_discs, empty_map
from hiernav.nav.option import PlanQuery, WaypointOption
from hiernav.nav.recovery import Recovery, ways_out
from hiernav.sim.robots import get_robot

PERIOD = 0.1
WINDOW, TRY, WAYS = 15, 5, 6
DURATION = TRY * WAYS  # of a recovery that moves nothing
AHEAD = 0.1 * np.arange(1, 11)[None, :, None] * [1.0, 0.0]
FAR = AHEAD + [9.0, 0.0]
FREE = empty_map((3.0, 3.0))
SENSORS = {"accelerometer": 3, "velocimeter": 3, "gyro": 3, "magnetometer": 3, "lidar": 10}


def drive(recovery: Recovery, positions: np.ndarray, plan: np.ndarray = AHEAD) -> list[bool]:
    """Whether the robot, which looks along +x, was given a way out at each of the positions (T, 2)."""
    poses = np.column_stack([np.asarray(positions, dtype=float), np.zeros(len(positions))])
    return [recovery(pose[None], plan, [FREE]) is not plan for pose in poses]


def test_a_robot_that_stands_is_shown_one_way_out_after_the_other_and_is_then_watched_anew() -> None:
    recovery = Recovery(1, PERIOD)
    helped = drive(recovery, np.zeros((2 * WINDOW + 2 * DURATION, 2)))
    begins = [t for t in range(1, len(helped)) if helped[t] and not helped[t - 1]]
    assert begins == [WINDOW, 2 * WINDOW + DURATION + 1]
    assert sum(helped[: begins[1]]) == DURATION
    assert recovery.counts.tolist() == [2]


@pytest.mark.parametrize(("changes", "begins"), [(1, 40), (15, 40), (16, 15), (1000, 15)])
def test_where_the_map_changes_a_robot_may_wait_longer(changes: int, begins: int) -> None:
    """Not before 1.5 s on one map, and after 4 s in any case."""
    recovery, maps = Recovery(1, PERIOD), [empty_map((3.0, 3.0)) for _ in range(60)]
    poses = np.zeros((1, 3))
    helped = [recovery(poses, AHEAD, [maps[t // changes]]) is not AHEAD for t in range(45)]
    assert helped.index(True) == begins


def test_after_a_reset_a_map_is_as_new_as_any() -> None:
    recovery, poses, last = Recovery(1, PERIOD), np.zeros((1, 3)), empty_map((3.0, 3.0))
    for step in range(300):
        recovery(poses + 0.1 * step, AHEAD + 0.1 * step, [empty_map((3.0, 3.0)) if step < 299 else last])
    recovery.reset()
    assert [recovery(poses, AHEAD, [last]) is not AHEAD for _ in range(20)].index(True) == WINDOW


def test_the_way_on_which_it_moves_is_followed_for_as_long_again_and_is_the_last() -> None:
    recovery, ways = Recovery(1, PERIOD), []
    for t in range(WINDOW + DURATION):
        moved = max(0, t - WINDOW - TRY)  # on the second way
        followed = recovery(np.array([[-0.02 * moved, 0.0, 0.0]]), AHEAD, [FREE])
        ways.append(None if followed is AHEAD else tuple(np.sign(followed[0, -1].round(6) - [-0.02 * moved, 0.0])))
    assert ways[WINDOW : WINDOW + TRY] == [(1.0, 0.0)] * TRY
    assert ways[WINDOW + TRY : WINDOW + 3 * TRY] == [(-1.0, 0.0)] * 2 * TRY
    assert ways[WINDOW + 3 * TRY] is None


def test_half_a_metre_away_the_plan_is_followed_again() -> None:
    recovery = Recovery(1, PERIOD)
    assert drive(recovery, np.zeros((WINDOW + 1, 2)))[-1]
    assert drive(recovery, np.array([[0.3, 0.0], [0.6, 0.0]])) == [True, False]


def test_a_robot_on_its_way_is_left_alone() -> None:
    recovery = Recovery(1, PERIOD)
    along = np.stack([0.004 * np.arange(200), np.zeros(200)], axis=1)
    assert not any(drive(recovery, along, FAR))
    assert any(drive(recovery, 0.5 * along, FAR)), "half as fast it covers 3 cm in the window"


def test_a_robot_that_is_asked_to_stay_may_stand() -> None:
    recovery = Recovery(1, PERIOD)
    assert not any(drive(recovery, np.zeros((100, 2)), np.zeros((1, 10, 2))))


def test_a_robot_whose_position_is_unknown_is_not_stuck() -> None:
    assert not any(drive(Recovery(1, PERIOD), np.full((100, 2), np.nan)))


def test_after_three_recoveries_in_one_place_it_is_given_up() -> None:
    recovery = Recovery(1, PERIOD)
    helped = drive(recovery, np.zeros((14 * WINDOW, 2)))
    assert sum(helped) == 3 * DURATION
    assert recovery.given_up.tolist() == [True]
    assert recovery.counts.tolist() == [3]


def test_coming_clear_of_the_place_gives_new_tries() -> None:
    recovery = Recovery(1, PERIOD)
    drive(recovery, np.zeros((14 * WINDOW, 2)))
    drive(recovery, np.stack([np.linspace(0.0, 0.6, 20), np.zeros(20)], axis=1), FAR)
    assert not recovery.given_up.any()
    assert sum(drive(recovery, np.full((14 * WINDOW, 2), (0.6, 0.0)), FAR)) == 3 * DURATION


def test_obstacles_look_farther_away_until_a_robot_that_stood_is_clear_of_the_place() -> None:
    recovery, terms = Recovery(2, PERIOD), {"lidar": np.full((2, 10), 0.5), "gyro": np.ones((2, 3))}
    plan, away = np.repeat(AHEAD, 2, axis=0), np.array([[0.0, 0.0, 0.0], [9.0, 9.0, 0.0]])
    for t in range(WINDOW + 1):
        assert recovery.dim(terms) is terms
        recovery(away + [[0.0, 0.0, 0.0], [0.1 * t, 0.0, 0.0]], plan, [FREE, FREE])
    dimmed = recovery.dim(terms)
    assert_allclose(dimmed["lidar"], np.repeat([[0.35], [0.5]], 10, axis=1))
    assert dimmed["gyro"] is terms["gyro"] and (terms["lidar"] == 0.5).all()
    one = np.array([1])
    assert (recovery.dim({"lidar": np.full((1, 10), 0.5)}, one)["lidar"] == 0.5).all()
    recovery(np.array([[0.45, 0.0, 0.0], [9.0, 9.0, 0.0]]), plan, [FREE, FREE])
    assert_allclose(recovery.dim(terms)["lidar"][0], 0.35)
    recovery(np.array([[0.55, 0.0, 0.0], [9.5, 9.0, 0.0]]), plan, [FREE, FREE])
    assert (recovery.dim(terms)["lidar"] == 0.5).all()


def test_each_robot_is_watched_for_itself_and_a_reset_forgets() -> None:
    recovery = Recovery(2, PERIOD)
    plan, helped = np.repeat(FAR, 2, axis=0), []
    for t in range(2 * WINDOW):
        if t == WINDOW - 1:
            recovery.reset(np.array([0]))
        poses = np.array([(0.0, 0.0, 0.0), (0.05 * t, 0.0, 0.0)])
        followed = recovery(poses, plan, [FREE, FREE])
        helped.append((followed != plan).any(axis=(1, 2)).tolist())
    assert not any(row[1] for row in helped)
    assert [row[0] for row in helped].index(True) == 2 * WINDOW - 1
    recovery.reset()
    assert not recovery.counts.any()


def test_some_rows_may_be_asked_about_alone() -> None:
    recovery = Recovery(3, PERIOD)
    for _ in range(WINDOW + 1):
        followed = recovery(np.zeros((1, 3)), AHEAD, [FREE], np.array([1]))
    assert recovery.active.tolist() == [False, True, False]
    assert followed is not AHEAD


def test_the_end_of_a_recovery_is_told_once_and_asks_for_another_plan() -> None:
    recovery, told = Recovery(1, PERIOD), []
    for _ in range(WINDOW + DURATION + 3):
        recovery(np.zeros((1, 3)), AHEAD, [FREE])
        told.append(bool(recovery.ended[0]))
    assert [t for t, ended in enumerate(told) if ended] == [WINDOW + DURATION]
    asked: list[int] = []
    actions: list[np.ndarray] = []

    class Asked:
        def plan(self, query: PlanQuery) -> np.ndarray:
            asked.append(len(actions))
            return query.position[:, None] + AHEAD

    agent = HierarchicalAgent(
        WaypointOption(Asked(), 1), lambda o: np.zeros((1, 2)), get_robot("point").observation_layout(), PERIOD
    )
    sensors = {name: np.zeros((1, size)) for name, size in SENSORS.items()}
    for _ in range(WINDOW + DURATION + 3):
        actions.append(agent.act(np.zeros((1, 3)), sensors, np.array([[2.0, 0.0]]), [FREE]).action)
    assert asked == [0, WINDOW + DURATION + 1]


# a map that changes on the way out


def with_box(center: tuple[float, float], half: tuple[float, float]) -> OccupancyMap:
    """A free map but for an upright box [m]."""
    walled = empty_map((3.0, 3.0))
    draw_boxes(walled.occupied, walled.origin, walled.resolution, np.array([center]), np.array([half]))
    return walled


def on_the_way(occupancy: OccupancyMap) -> tuple[Recovery, list[np.ndarray]]:
    """A recovery that has begun ahead on a free map, and what it says in the next steps on another map."""
    recovery = Recovery(1, PERIOD)
    recovery.ask(0)
    assert bearings([recovery(np.zeros((1, 3)), AHEAD, [FREE])[0]]) == [0]
    return recovery, [recovery(np.zeros((1, 3)), AHEAD, [occupancy])[0] for _ in range(3)]


def test_a_way_that_is_blocked_while_it_is_followed_is_left_for_the_next_free_one() -> None:
    wall = with_box((0.3, 0.0), (0.05, 3.0))
    recovery, ways = on_the_way(wall)
    assert bearings(ways) == [180] * 3
    assert wall.is_free(np.array(ways), 0.1).all()
    assert recovery.active.all()


def test_a_way_that_is_blocked_farther_off_ends_there() -> None:
    wall = with_box((0.6, 0.0), (0.05, 3.0))
    ways = on_the_way(wall)[1]
    assert bearings(ways) == [0] * 3
    assert wall.is_free(np.array(ways), 0.1).all() and ways[0][:, 0].max() == pytest.approx(0.4)


def test_a_robot_that_is_free_to_no_side_any_more_is_asked_to_stay() -> None:
    ring = np.pad(np.zeros((4, 4), dtype=bool), 58, constant_values=True)
    recovery, ways = on_the_way(OccupancyMap(ring, 0.05, FREE.origin))
    assert_allclose(ways, np.zeros((3, 10, 2)), atol=1e-12)
    helped = [recovery(np.zeros((1, 3)), AHEAD, [OccupancyMap(ring, 0.05, FREE.origin)]) for _ in range(DURATION)]
    assert helped[-1] is AHEAD, "for as long as a recovery lasts at most"


def test_the_next_way_leads_from_where_the_robot_is_and_over_the_map_as_it_is_then() -> None:
    recovery = Recovery(1, PERIOD)
    recovery.ask(0)
    behind = with_box((-0.4, 0.0), (0.05, 3.0))
    for t in range(TRY + 1):
        drifted = np.array([[0.0, 0.008 * t, 0.0]])
        followed = recovery(drifted, AHEAD, [behind if t > 2 else FREE])[0]
    assert_allclose(followed[0] - drifted[0, :2], [-0.1, 0.0], atol=1e-12)
    assert followed[:, 0].min() == pytest.approx(-0.2) and behind.is_free(followed, 0.1).all()


def test_a_robot_that_was_pushed_aside_is_not_led_back_through_what_lies_between() -> None:
    recovery = Recovery(1, PERIOD)
    recovery.ask(0)
    recovery(np.zeros((1, 3)), AHEAD, [FREE])
    wall = with_box((0.0, 0.15), (3.0, 0.025))
    followed = recovery(np.array([[0.0, 0.35, 0.0]]), AHEAD, [wall])[0]
    assert followed[:, 1].min() > 0.3


def test_no_way_out_is_looked_for_from_an_unknown_pose() -> None:
    recovery = Recovery(1, PERIOD)
    recovery.ask(0)
    assert recovery(np.full((1, 3), np.nan), AHEAD, [FREE]) is AHEAD
    assert not recovery.active.any()


# the ways out


def ways(plan: np.ndarray, yaw: float = 0.0, occupancy: OccupancyMap = FREE) -> list[np.ndarray]:
    return list(ways_out(np.array([0.0, 0.0, yaw]), plan, occupancy, 0.1)[1])


def bearings(ways: list[np.ndarray], yaw: float = 0.0) -> list[int]:
    """Relative to the heading [deg], counter-clockwise, 180 for straight back."""
    degrees = [np.degrees(np.arctan2(way[-1, 1], way[-1, 0]) - yaw) for way in ways]
    return [round(180.0 - (180.0 - value) % 360.0) for value in degrees]


@pytest.mark.parametrize(
    ("plan", "order"),
    [
        ((1.0, 0.1), [0, 180, 90, -90, 45, -45, 135, -135]),
        ((1.0, -0.1), [0, 180, -90, 90, -45, 45, -135, 135]),
        ((-1.0, 0.1), [180, 0, 90, -90, 135, -135, 45, -45]),
        ((-1.0, -0.1), [180, 0, -90, 90, -135, 135, -45, 45]),
    ],
)
@pytest.mark.parametrize("yaw", [0.0, 0.9, -2.7])
def test_ways_out_lead_straight_to_all_sides_the_plan_s_first(plan: object, order: list[int], yaw: float) -> None:
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    found = ways(0.1 * np.arange(1, 11)[:, None] * plan @ turn, yaw)
    assert bearings(found, yaw) == order
    spacing = 0.1 * np.hypot(1.0, 0.1)
    assert_allclose([np.linalg.norm(way, axis=1) for way in found], np.tile(spacing * np.arange(1, 11), (8, 1)))


def test_the_next_recovery_in_one_place_begins_where_the_last_one_ended() -> None:
    recovery, seen = Recovery(1, PERIOD), []
    for _ in range(2 * (WINDOW + DURATION)):
        followed = recovery(np.zeros((1, 3)), AHEAD, [FREE])
        seen += [] if followed is AHEAD else bearings([followed[0]])
    assert seen[::TRY] == [0, 180, 90, -90, 45, -45, 135, -135, 0, 180, 90, -90]


def test_a_way_out_ends_where_the_map_is_not_free() -> None:
    walled = empty_map((3.0, 3.0))
    draw_discs(walled.occupied, walled.origin, walled.resolution, np.array([[0.75, 0.0]]), 0.2)
    out = ways(AHEAD[0], occupancy=walled)[0]
    assert out[:, 0].max() == pytest.approx(0.4) and walled.is_free(out, 0.1).all()
    assert_allclose(out[4:], np.broadcast_to(out[3], (6, 2)))


def test_ways_that_are_blocked_at_once_come_last() -> None:
    walled = empty_map((3.0, 3.0))
    draw_discs(walled.occupied, walled.origin, walled.resolution, np.array([[0.45, 0.0]]), 0.2)
    found = ways(AHEAD[0], occupancy=walled)
    assert bearings(found[:1]) == [180]
    assert np.linalg.norm(found[-1][-1]) < 0.2


def test_no_way_out_leads_across_a_wall_of_a_robot_that_has_come_along_its_plan() -> None:
    wall = with_box((0.2, 0.0), (0.05, 3.0))
    plan = np.column_stack([np.zeros(10), np.linspace(-0.4, 0.5, 10)])
    found = ways(plan, occupancy=wall)
    assert max(way[:, 0].max() for way in found) < 0.1
    assert bearings(found[:1]) == [180]
    assert_allclose(np.linalg.norm(found[0], axis=1), 0.1 * np.arange(1, 11))


def test_ways_out_are_swept_between_their_waypoints() -> None:
    thin = with_box((0.45, 0.0), (0.025, 3.0))
    found = ways(3.0 * AHEAD[0], occupancy=thin)
    assert thin.is_free([[0.3, 0.0], [0.6, 0.0]], 0.1).all()
    assert max(way[:, 0].max() for way in found) == pytest.approx(0.3)


def test_a_robot_that_touches_an_obstacle_is_free_to_leave_it() -> None:
    walled = with_box((0.1, 0.0), (0.05, 3.0))
    assert not walled.is_free(np.zeros(2), 0.1)
    found = ways(AHEAD[0], occupancy=walled)
    assert bearings(found[:1]) == [180] and np.linalg.norm(found[0][-1]) == pytest.approx(1.0)
    assert max(way[:, 0].max() for way in found) < 0.01


def test_a_plan_that_ends_at_the_goal_still_tells_how_far_apart_its_waypoints_are() -> None:
    short = AHEAD[0, np.minimum(np.arange(10), 2)]
    assert_allclose(np.linalg.norm(ways(short)[0], axis=1), 0.1 * np.arange(1, 11))


def test_a_robot_that_is_walled_in_stays() -> None:
    walled = empty_map((3.0, 3.0))
    walled.occupied[:] = True
    assert_allclose(ways(AHEAD[0], occupancy=walled), np.zeros((8, 10, 2)), atol=1e-12)


def test_the_first_way_out_imports_nothing() -> None:
    """That would be in a control step, from a disk that may be slow, in a process that may have no file left."""
    program = (
        "import sys\nimport numpy as np\nfrom hiernav.nav.occupancy import empty_map\n"
        "from hiernav.nav.recovery import ways_out\nbefore = set(sys.modules)\n"
        "ways_out(np.zeros(3), 0.1 * np.ones((10, 2)) * np.arange(1, 11)[:, None], empty_map((2.0, 2.0)), 0.1)\n"
        "print(sorted(set(sys.modules) - before))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True).stdout == "[]\n"
