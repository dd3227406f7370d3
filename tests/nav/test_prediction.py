"""Maps as they will be: what moves is drawn where it will be, and everything else stays as it is."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from hiernav.nav.occupancy import OccupancyMap, VisitMap, draw_boxes, draw_discs, empty_map
from hiernav.nav.option import PlanQuery, WaypointOption
from hiernav.nav.planners import ShortestPathPlanner
from hiernav.nav.prediction import AHEAD_S, GAP_S, LARGEST_M, LOOK_S, MOST, NEAR_M, NEAR_PIXELS, MapPredictor

HERE = np.zeros(2)
PERIOD = 0.1
RADIUS = 0.15


def drawn(*centers: tuple[float, float] | np.ndarray, half: float = 3.0) -> OccupancyMap:
    """Discs, and a wall that stands."""
    field = empty_map((half, half))
    draw_boxes(field.occupied, field.origin, field.resolution, np.array([[0.0, 1.5]]), np.array([[1.0, 0.05]]))
    draw_discs(field.occupied, field.origin, field.resolution, np.array(centers).reshape(-1, 2), RADIUS)
    return field


def watched(path, steps: int, period: float = PERIOD, position: np.ndarray = HERE) -> tuple[OccupancyMap, OccupancyMap]:
    """The last of some maps with discs at `path(time)`, and its prediction."""
    predictor = MapPredictor()
    for step in range(steps):
        now = drawn(*path(step * period))
        ahead = predictor(now, step * period, position)
    return now, ahead


def centre_near(occupancy: OccupancyMap, point: np.ndarray) -> np.ndarray:
    """Centre [m] of what is occupied within 0.3 m of a point (2,) [m]."""
    row, col = np.nonzero(occupancy.occupied)
    at = np.array(occupancy.origin) + (np.stack([col, row], axis=1) + 0.5) * occupancy.resolution
    near = at[np.linalg.norm(at - point, axis=1) < 0.3]
    assert len(near), f"nothing at {point}"
    return near.mean(axis=0)


def straight(time: float) -> list[np.ndarray]:
    return [np.array([-1.2, -1.0]) + time * np.array([0.4, 0.1])]


def circling(time: float) -> list[np.ndarray]:
    return [np.array([-0.5, -1.0]) + 0.35 * np.array([np.cos(1.2 * time), np.sin(1.2 * time)])]


@pytest.mark.parametrize("path", [straight, circling])
@pytest.mark.parametrize("period", [0.02, 0.04, 0.1, 0.2])
def test_what_moves_is_where_it_will_be_and_no_longer_where_it_is(path, period: float) -> None:
    steps = round(1.6 / period) + 1
    now, ahead = watched(path, steps, period)
    # the map is looked at every 0.1 s, so that the prediction may be that much older
    moments = 1.6 + AHEAD_S - np.array([0.0, LOOK_S, 2 * period])
    there = [path(moment)[0] for moment in moments]
    assert min(np.linalg.norm(centre_near(ahead, there[0]) - each) for each in there) < 0.07
    assert not ahead.occupied_at(path(1.6)[0])
    assert abs(int(ahead.occupied.sum()) - int(now.occupied.sum())) <= 4  # a disc on other pixels


def test_what_stands_is_left_as_it_is() -> None:
    now, ahead = watched(lambda time: [*straight(time), np.array([1.0, 0.5])], 15)
    standing = drawn((1.0, 0.5)).occupied
    assert ahead.occupied[standing].all()
    assert (ahead.resolution, ahead.origin, ahead.occupied.shape) == (now.resolution, now.origin, now.occupied.shape)
    row, col = np.nonzero(ahead.occupied & ~now.occupied)
    new = np.array(now.origin) + (np.stack([col, row], axis=1) + 0.5) * now.resolution
    assert len(new) > 10
    assert (np.linalg.norm(new - straight(1.4 + AHEAD_S)[0], axis=1) < RADIUS + 2 * now.resolution).all()


def test_a_map_on_which_nothing_moves_is_its_own_prediction() -> None:
    predictor, one = MapPredictor(), drawn((0.5, 0.5))
    assert all(predictor(one, step * PERIOD, HERE) is one for step in range(30))
    for step in range(30, 60):  # published again and again
        again = drawn((0.5, 0.5))
        assert predictor(again, step * PERIOD, HERE) is again


def test_a_map_is_given_back_untouched() -> None:
    predictor, maps = MapPredictor(), [drawn(*straight(step * PERIOD)) for step in range(20)]
    copies = [each.occupied.copy() for each in maps]
    for step, each in enumerate(maps):
        predictor(each, step * PERIOD, HERE)
    for each, copy in zip(maps, copies, strict=True):
        assert_array_equal(each.occupied, copy)


def test_the_same_map_has_the_same_prediction_until_it_is_old() -> None:
    predictor = MapPredictor()
    for step in range(15):
        now = drawn(*straight(step * PERIOD))
        ahead = predictor(now, step * PERIOD, HERE)
    last = 14 * PERIOD
    assert ahead is not now
    assert predictor(now, last + GAP_S, HERE) is ahead
    assert predictor(now, last + GAP_S + 0.01, HERE) is now, "it has not moved for so long"
    assert predictor(now, last + 9.0, HERE) is now
    assert predictor(drawn(*straight(last + 9.0)), last + 9.0, HERE) is not ahead


def test_maps_that_come_faster_are_not_all_looked_at() -> None:
    predictor, different = MapPredictor(), []
    for step in range(200):
        ahead = predictor(drawn(*straight(0.01 * step)), 0.01 * step, HERE)
        if not different or different[-1] is not ahead:
            different.append(ahead)
    moving = 200 - round(0.3 / 0.01)  # as long as it is not known to move, a map is given back as it is
    assert len(different) <= 200 - moving + round(moving * 0.01 / LOOK_S) + 2


def test_what_has_just_appeared_is_not_predicted() -> None:
    predictor = MapPredictor()
    for step in range(10):
        predictor(drawn((1.0, 0.5)), step * PERIOD, HERE)
    for step in (10, 11):
        now = drawn((1.0, 0.5), straight(step * PERIOD)[0])
        assert predictor(now, step * PERIOD, HERE) is now


def test_what_comes_to_lie_outside_of_the_map_is_gone() -> None:
    now, ahead = watched(lambda time: [np.array([0.5 + 1.4 * time, -1.0])], 16)
    assert now.occupied_at(np.array([0.5 + 1.4 * 1.5, -1.0]))
    assert ahead.occupied.sum() < now.occupied.sum()
    assert_array_equal(ahead.occupied, drawn().occupied)


def test_where_two_touch_they_stand_until_they_have_been_watched_anew() -> None:
    def meeting(time: float) -> list[np.ndarray]:
        return [np.array([-0.9 + 0.5 * time, -0.8]), np.array([0.9 - 0.5 * time, -0.8])]

    now, ahead = watched(meeting, 18)  # 0.05 m apart by now, so that their pixels touch
    assert ahead is now
    now, ahead = watched(meeting, 10)
    assert ahead is not now


def test_obstacles_that_change_their_shape_or_jump_are_others() -> None:
    predictor = MapPredictor()
    for step in range(20):
        field = empty_map((3.0, 3.0))
        center = np.array([[-0.8 + 0.04 * step, -0.5]])
        draw_discs(field.occupied, field.origin, field.resolution, center, 0.1 if step % 2 else 0.25)
        assert predictor(field, step * PERIOD, HERE) is field
    for step in range(20, 40):
        now = drawn((-1.0, -0.5) if step % 2 else (0.5, -1.5))
        assert predictor(now, step * PERIOD, HERE) is now


def test_far_obstacles_are_left_as_they_are() -> None:
    def far(time: float) -> OccupancyMap:
        return drawn(np.array([NEAR_M + 1.0 - 0.3 * time, 0.0]), half=6.0)

    predictor = MapPredictor()
    for step in range(20):
        now = far(step * PERIOD)
        assert predictor(now, step * PERIOD, HERE) is now
    for step in range(20, 40):
        now = far(step * PERIOD)
        ahead = predictor(now, step * PERIOD, np.array([3.0, 0.0]))
    assert ahead is not now


def test_with_too_many_obstacles_none_is_predicted() -> None:
    specks = np.stack(np.meshgrid(np.arange(-2.8, 2.8, 0.2), np.arange(-2.8, -1.2, 0.2)), axis=-1).reshape(-1, 2)
    assert len(specks) > MOST
    predictor = MapPredictor()
    for step in range(20):
        now = drawn(*straight(step * PERIOD))
        row, col = now.pixel_of(specks)
        now.occupied[row, col] = True
        assert predictor(now, step * PERIOD, HERE) is now


def predicting() -> tuple[MapPredictor, float]:
    """A predictor that knows how something moves, and the time of the next map."""
    predictor = MapPredictor()
    for step in range(15):
        now = drawn(*straight(step * PERIOD))
        ahead = predictor(now, step * PERIOD, HERE)
    assert ahead is not now
    return predictor, 15 * PERIOD


@pytest.mark.parametrize("stamp", [np.nan, np.inf, 0.0, 14 * PERIOD, 15 * PERIOD + GAP_S])
def test_where_the_clock_cannot_be_right_the_map_is_taken_as_it_is(stamp: float) -> None:
    """No time, one that goes back or stands although the map is another one, and one that has jumped."""
    predictor, _ = predicting()
    now = drawn(*straight(1.5))
    assert predictor(now, stamp, HERE) is now
    for step in range(40):  # and it goes on
        ahead = predictor(drawn(*straight(2.0 + step * PERIOD)), 100.0 + step * PERIOD, HERE)
    assert ahead.occupied_at(straight(2.0 + 39 * PERIOD + AHEAD_S)[0])


def test_without_a_position_or_on_another_grid_the_map_is_taken_as_it_is() -> None:
    for now, position in (
        (drawn(*straight(1.5)), np.full(2, np.nan)),
        (drawn(*straight(1.5), half=3.5), HERE),
        (OccupancyMap(np.zeros((120, 120), bool), 0.04, (-3.0, -3.0)), HERE),
        (OccupancyMap(np.zeros((1, 1), bool), 0.05, (9.0, -9.0)), HERE),
    ):
        predictor, stamp = predicting()
        assert predictor(now, stamp, position) is now
        assert predictor(now, stamp + PERIOD, position) is now


@pytest.mark.parametrize("speed", [0.3, 0.8, 1.5])
@pytest.mark.parametrize("period", [0.04, 0.1, 0.2])
def test_what_stops_is_shown_where_it_stands_within_three_tenths_of_a_second(speed: float, period: float) -> None:
    for republished in (True, False):
        predictor, shown, last = MapPredictor(), [], None
        for step in range(round(3.0 / period)):
            stamp = step * period
            at = np.array([-1.6 + speed * min(stamp, 1.0), -1.0])
            if last is None or republished or stamp <= 1.0 + 1e-9:
                last = drawn(at)
            ahead = predictor(last, stamp, np.array([0.0, 2.8]))
            if stamp > 1.0 + (0.3 if republished else GAP_S):
                shown.append(bool(ahead.occupied_at(at)))
        assert len(shown) > 5 and all(shown)


@pytest.mark.parametrize("speed", [0.3, 0.5, 1.0])
def test_walls_in_sight_of_a_lidar_stand(speed: float) -> None:
    """Everything stands; the map comes along with the robot and holds what is within 2.5 m of it."""
    predictor = MapPredictor()
    for step in range(round(2.0 / speed / PERIOD)):
        position = np.array([-1.5 + speed * step * PERIOD, 0.0])
        corner = np.round((position - 4.0) / 0.05) * 0.05
        now = OccupancyMap(np.zeros((160, 160), bool), 0.05, (float(corner[0]), float(corner[1])))
        boxes = np.array([[-3.0, 1.0], [2.0, -0.25], [0.5, -1.0]]), np.array([[5.0, 0.05], [0.05, 1.3], [0.2, 0.2]])
        draw_boxes(now.occupied, now.origin, now.resolution, *boxes)
        row, col = np.nonzero(now.occupied)
        at = corner + (np.stack([col, row], axis=1) + 0.5) * 0.05
        hidden = np.linalg.norm(at - position, axis=1) > 2.5
        now.occupied[row[hidden], col[hidden]] = False
        assert predictor(now, step * PERIOD, position) is now


@pytest.mark.parametrize("speed", [0.3, 0.8])
def test_who_walks_past_a_wall_and_touches_it_does_not_take_it_along(speed: float) -> None:
    predictor, wall = MapPredictor(), empty_map((3.0, 3.0))
    draw_boxes(wall.occupied, wall.origin, wall.resolution, np.array([[0.0, -1.0]]), np.array([[0.45, 0.1]]))
    for step in range(40):
        now = OccupancyMap(wall.occupied.copy(), wall.resolution, wall.origin)
        center = np.array([[-1.5 + speed * step * PERIOD, -0.8]])
        draw_discs(now.occupied, now.origin, now.resolution, center, RADIUS)
        assert predictor(now, step * PERIOD, np.array([0.0, 2.0])).occupied[wall.occupied].all()


@pytest.mark.parametrize("speed", [0.3, 0.8, 1.5])
@pytest.mark.parametrize("distance", [0.4, 0.7, 1.0])
def test_no_plan_leads_through_what_comes_head_on(speed: float, distance: float) -> None:
    predictor, goal = MapPredictor(), np.array([[2.0, -2.0]])
    start = np.array([-2.0, -2.0])
    for step in range(12):
        at = start + [distance + speed * (11 - step) * PERIOD, 0.0]
        now = drawn(at)
        ahead = predictor(now, step * PERIOD, start)
    planner = ShortestPathPlanner(0.1)
    query = PlanQuery(start[None], goal, [ahead], [VisitMap(now)], np.full((1, 10, 2), np.nan))
    plan = planner.plan(query)[0]
    assert now.is_free(plan[:-1], 0.05).all()
    assert ahead is not now


def test_another_one_in_the_place_of_one_that_has_gone_is_shown() -> None:
    for period in (0.1, 0.2, 0.34):
        predictor = MapPredictor()
        for step in range(20):
            at = (-1.0, -1.0) if step < 10 else (-0.75, -1.0)
            now = drawn(at)
            assert predictor(now, step * period, np.array([0.0, 2.0])) is now


def test_of_a_large_or_fine_map_a_part_is_looked_at() -> None:
    """A disc beyond the part is left as it is: no more than 321 x 321 pixels are compared, however many there are."""
    resolution = 0.01
    beyond = (NEAR_PIXELS + 40) * resolution
    assert beyond < NEAR_M
    for at, moves in ((0.5, True), (beyond, False)):
        predictor = MapPredictor()
        for step in range(15):
            now = OccupancyMap(np.zeros((500, 500), bool), resolution, (-1.0, -2.5))
            center = np.array([[at, -1.0 + 0.3 * step * PERIOD]])
            draw_discs(now.occupied, now.origin, resolution, center, RADIUS)
            ahead = predictor(now, step * PERIOD, np.array([0.0, -0.6]))
        assert (ahead is not now) is moves


def test_what_is_longer_than_a_metre_is_left_as_it_is() -> None:
    for half, moves in ((0.5 * LARGEST_M - 0.1, True), (0.5 * LARGEST_M + 0.1, False)):
        predictor = MapPredictor()
        for step in range(15):
            now = empty_map((3.0, 3.0))
            center = np.array([[-0.5, -2.0 + 0.3 * step * PERIOD]])
            draw_boxes(now.occupied, now.origin, now.resolution, center, np.array([[half, 0.1]]))
            ahead = predictor(now, step * PERIOD, np.array([0.0, 2.0]))
        assert (ahead is not now) is moves


def test_after_a_reset_nothing_is_known() -> None:
    predictor = MapPredictor()
    for step in range(15):
        predictor(drawn(*straight(step * PERIOD)), step * PERIOD, HERE)
    predictor.reset()
    now = drawn(*straight(1.5))
    assert predictor(now, 1.5, HERE) is now


class Asked:
    """Goes straight on, and keeps the maps that it was asked with."""

    def __init__(self) -> None:
        self.maps: list[OccupancyMap] = []

    def plan(self, query: PlanQuery) -> np.ndarray:
        self.maps += query.occupancy
        return query.position[:, None] + 0.1 * np.arange(1, 11)[None, :, None] * [0.0, -1.0]


@pytest.mark.parametrize("predict", [True, False])
def test_an_option_plans_on_the_map_ahead(predict: bool) -> None:
    planner = Asked()
    option = WaypointOption(planner, 1, predict=predict)
    for step in range(16):
        now = drawn(*straight(step * PERIOD))
        if step == 15:
            option.waiting[0] = True
        option.step(HERE[None], np.array([[0.0, -2.5]]), [now], stamps=np.array([step * PERIOD]))
    assert (planner.maps[-1] is now) is not predict
    assert planner.maps[-1].occupied_at(straight(1.5 + AHEAD_S * predict)[0])


def test_rows_have_times_of_their_own_and_without_time_nothing_is_predicted() -> None:
    planner = Asked()
    option, goal = WaypointOption(planner, 2), np.array([[0.0, -2.5]] * 2)
    for step in range(16):
        now = drawn(*straight(0.06 * step))
        option.waiting[:] = step == 15
        # by the second one's clock it is slower than what counts as moving
        option.step(np.zeros((2, 2)), goal, [now, now], stamps=np.array([0.05, 0.34]) * step)
    assert planner.maps[-2] is not now and planner.maps[-1] is now
    option.reset()
    option.step(np.zeros((2, 2)), goal, [now, now], stamps=np.array([0.8, 5.44]))
    assert planner.maps[-2:] == [now, now]
    timeless = WaypointOption(planner, 1)
    for step in range(16):
        now = drawn(*straight(step * PERIOD))
        timeless.waiting[0] = step == 15
        timeless.step(HERE[None], goal[:1], [now])
    assert planner.maps[-1] is now


def test_a_finer_map_is_known_better() -> None:
    """The centre of what is drawn, against where it will be, on pixels of 5 and of 2 cm."""
    errors = []
    for resolution in (0.05, 0.02):
        predictor, side = MapPredictor(), round(6.0 / resolution)
        for step in range(16):
            field = OccupancyMap(np.zeros((side, side), bool), resolution, (-3.0, -3.0))
            draw_discs(field.occupied, field.origin, resolution, np.array(circling(step * PERIOD)), RADIUS)
            ahead = predictor(field, step * PERIOD, HERE)
        there = circling(1.5 + AHEAD_S)[0]
        errors.append(float(np.linalg.norm(centre_near(ahead, there) - there)))
    assert errors[1] < 0.02
    assert_allclose(errors[0], 0.0, atol=0.07)
