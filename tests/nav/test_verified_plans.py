"""A plan that is handed out is free, or none is, for a reason; and it does not change sides without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nav_planners import WatchedPlanner, map_with_pillars, query_of
from numpy.testing import assert_allclose

from hiernav.nav import goselo
from hiernav.nav.bundle import load_bundle
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.option import PlanQuery
from hiernav.nav.planners import (
    GoseloPlanner,
    ShortestPathPlanner,
    StraightPlanner,
    VerifiedPlanner,
    apart_from,
    verified_planner,
)
from hiernav.nav.search import CELL, GOAL_REACH, REFUSALS, PathField, goal_reach_for, keeps_room
from hiernav.runtime.policy import load_networks
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.walk import walk
from hiernav.sim.worlds import sample_layout

SIX_WORLDS = ("pillar(2,2,10)", "pillar(3,3,25)", "pillar(4,4,40)", "gremlin", "two-room", "four-room")
BUNDLE = Path(__file__).parents[2] / "deploy" / "bundles" / "point"


def layouts_of(world: str, count: int, radius: float) -> list[Layout]:
    return [sample_layout(parse_world(world), seed, radius) for seed in range(count)]


def verified(radius: float, proposer=None) -> VerifiedPlanner:
    return VerifiedPlanner(proposer or WatchedPlanner(), ShortestPathPlanner(radius, soft_margin=0.15), radius)


@pytest.fixture(scope="module")
def network() -> GoseloPlanner:
    bundle = load_bundle(BUNDLE)
    return GoseloPlanner(load_networks(bundle).planner, bundle.manifest.goselo.channels, 0.1, 0.15)


# free plans


@pytest.mark.parametrize("radius", [0.1, 0.2])
@pytest.mark.parametrize("world", SIX_WORLDS)
def test_with_repair_a_disc_touches_nothing_however_bad_the_proposals_are(world: str, radius: float) -> None:
    layouts = layouts_of(world, 6, radius)
    blind, checked = WatchedPlanner(), verified(radius)
    assert walk(blind, layouts, radius).collisions.sum() > 0, "straight at the goal hits something in these worlds"
    result = walk(checked, layouts, radius)
    assert result.collisions.sum() == 0
    assert result.reached.all()
    assert checked.counts()["repairs"] > 0 and checked.tally["refusals"] == 0
    assert checked.tally["proposals"] == result.plans.sum()


@pytest.mark.parametrize("world", SIX_WORLDS)
def test_with_repair_the_shipped_network_touches_nothing(world: str, network: GoseloPlanner) -> None:
    result = walk(verified(0.1, network), layouts_of(world, 10, 0.1), 0.1)
    assert result.collisions.sum() == 0 and result.reached.all()


# refusals


def walled(row: slice, half_size: float = 1.0) -> OccupancyMap:
    occupancy = map_with_pillars(half_size=(half_size, half_size))
    occupancy.occupied[:, row] = True
    return occupancy


@pytest.mark.parametrize(
    ("reason", "occupancy", "start", "goal"),
    [
        ("enclosed", walled(slice(19, 21)), (-0.5, 0.0), (0.6, 0.0)),
        ("goal_blocked", walled(slice(22, None)), (-0.5, 0.0), (0.8, 0.0)),
        ("no_room", OccupancyMap(np.ones((40, 40), bool), origin=(-1.0, -1.0)), (-0.5, 0.0), (0.6, 0.0)),
        ("not_finite", map_with_pillars(), (0.0, 0.0), (np.nan, 0.0)),
    ],
)
def test_a_refusal_has_a_reason(reason: str, occupancy: OccupancyMap, start, goal) -> None:
    planner = verified(0.1)
    assert np.isnan(planner.plan(query_of([start], [goal], occupancy))).all()
    assert planner.tally["refusals"] == 1
    assert planner.counts()[f"refusals/{reason}"] == 1 and reason in REFUSALS


@pytest.mark.parametrize("radius", [0.1, 0.2])
@pytest.mark.parametrize("start", [(0.0, -0.6), (0.0, -0.9)])
def test_a_plan_through_a_gap_that_the_disc_does_not_fit_is_no_repair(radius: float, start) -> None:
    opening = map_with_pillars(half_size=(2.0, 2.0))
    opening.occupied[39:41] = True
    opening.occupied[39:41, 39:41] = False  # 0.1 m wide
    planner = VerifiedPlanner(StraightPlanner(), ShortestPathPlanner(radius), radius)
    assert np.isnan(planner.plan(query_of([start], [(0.0, 1.0)], opening))).all()
    assert (planner.tally["repairs"], planner.tally["refusals"], planner.tally["refusals/enclosed"]) == (0, 1, 1)


def test_a_shortest_path_along_which_the_disc_does_not_fit_is_no_repair() -> None:
    """Whoever made it: here one that keeps too little room."""
    opening = map_with_pillars(half_size=(2.0, 2.0))
    opening.occupied[39:41] = True
    opening.occupied[39:41, 37:43] = False  # 0.3 m wide
    planner = VerifiedPlanner(StraightPlanner(), ShortestPathPlanner(0.2), 0.2)
    careless = ShortestPathPlanner(0.1).plan
    planner.repair.plan = careless
    assert np.isfinite(careless(query_of([(0.0, -0.6)], [(0.0, 1.0)], opening))).all()
    assert np.isnan(planner.plan(query_of([(0.0, -0.6)], [(0.0, 1.0)], opening))).all()
    assert (planner.tally["repairs"], planner.tally["refusals"]) == (0, 1)


@pytest.mark.parametrize("world", ["pillar(2,2,10)", "pillar(4,4,40)"])
def test_what_the_verified_expert_hands_out_fits_the_disc_once_it_has_fitted(world: str) -> None:
    """From anywhere: where the disc does not fit at the start, the way leads out of there, and not in again."""
    radius, tight, planner = 0.2, 0, verified(0.2)
    for layout in layouts_of(world, 4, radius):
        occupancy = layout.occupancy(0.0)
        xmin, xmax, ymin, ymax = occupancy.extent
        starts = np.random.default_rng(1).uniform((xmin, ymin), (xmax, ymax), (80, 2))
        starts = starts[occupancy.clearance_at(starts) > 0.03]
        plans = planner.plan(query_of(starts, [layout.goal] * len(starts), occupancy))
        for start, plan in zip(starts, plans, strict=True):
            if np.isnan(plan).any():
                continue
            line = np.concatenate([start[None], plan])
            points = np.concatenate([np.linspace(a, b, 5) for a, b in zip(line[:-1], line[1:], strict=True)])
            clearance = occupancy.clearance_at(points)
            fits = int(np.argmax(clearance >= radius))
            assert clearance[fits] >= radius and (clearance[fits:] >= radius - 0.02).all()
            tight += fits > 0
    assert tight > 20 and planner.tally["repairs"] > 50


def test_a_goal_a_little_too_close_to_a_wall_is_gone_to_as_near_as_the_disc_fits() -> None:
    occupancy = walled(slice(30, None))  # from x = 0.5 m on
    goal = np.array([0.47, 0.0])
    plan = PathField(occupancy, goal, 0.1).waypoints(np.array([0.0, 0.0]))
    assert occupancy.is_free(plan, 0.1).all()
    assert np.linalg.norm(plan[-1] - goal) < GOAL_REACH
    assert PathField(occupancy, np.array([0.9, 0.0]), 0.1).waypoints(np.array([0.0, 0.0])) is None


@pytest.mark.parametrize("goal_radius", [0.2, 0.3])
@pytest.mark.parametrize("wall", [24, 27, 30])  # from x = 0.2, 0.35 or 0.5 m on
def test_a_plan_ends_where_the_goal_counts_as_reached_with_room_to_spare(goal_radius: float, wall: int) -> None:
    """However deep the goal lies in the wall: within the goal's radius less 0.1 m, or it is refused."""
    occupancy, reach, planned = walled(slice(wall, None)), goal_reach_for(goal_radius), 0
    start = np.array([-0.7, 0.0])
    for x in np.arange(0.0, 0.8, 0.01):
        planner = verified_planner(StraightAhead(), goselo.CHANNELS, ShortestPathPlanner(0.1), 0.1, goal_radius)
        query, depth = query_of([start], [(x, 0.0)], occupancy), x - (-1.0 + 0.05 * wall - 0.1)
        end = planner.repair.field(occupancy, query.goal[0]).path_from(start)
        if end is None:
            assert depth > reach - 0.05 and planner.repair.refusal(query, 0) == "goal_blocked"
            continue
        planned += 1
        assert np.linalg.norm(end[-1] - query.goal[0]) <= reach
        assert occupancy.clearance_at(end[-1]) >= 0.1 - 1e-9
        assert np.linalg.norm(end[-1] - query.goal[0]) <= max(depth, 0.0) + 0.05, "about as near as it fits"
        near = planner.repair.field(occupancy, query.goal[0]).waypoints(end[-1] - [0.3, 0.0])
        assert_allclose(near[-1], end[-1], atol=0.005)
    assert planned > 15


@pytest.mark.parametrize("radius", [0.1, 0.2])
def test_a_goal_with_room_in_a_cell_without_is_the_end_of_its_paths(radius: float) -> None:
    ends = 0
    for layout in layouts_of("pillar(4,4,40)", 4, radius):
        occupancy = layout.occupancy(0.0)
        for goal in np.random.default_rng(3).uniform(-4.0, 4.0, (120, 2)):
            center = (np.floor(goal / CELL) + 0.5) * CELL
            if occupancy.clearance_at(goal) >= radius > occupancy.clearance_at(center):
                field = PathField(occupancy, goal, radius)
                path = field.path_from(layout.start[:2])
                if path is not None:
                    ends += 1
                    assert np.linalg.norm(path[-1] - goal) <= 0.05
                    assert keeps_room(occupancy.clearance_at(path[-2:])[None], radius, 0.015)[0]
    assert ends > 2


class StraightAhead:
    """A network of one hypothesis: straight to the goal."""

    def __call__(self, image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ahead = 0.1 * np.arange(1, 11)[None, None, :, None] * np.array([0.0, 1.0])
        return np.repeat(ahead, len(image), axis=0), np.zeros((len(image), 1))


# hysteresis


class Undecided:
    """Left and right of the pillar ahead, with scores that change at random from one query to the next."""

    def __init__(self, spread: float) -> None:
        self.rng, self.spread = np.random.default_rng(1), spread

    def __call__(self, image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        along = 0.1 * np.arange(1, 11)
        bow = 0.45 * np.sin(np.pi * np.minimum(along, 1.2) / 1.2)
        plans = np.stack([np.stack([side * bow, along], axis=-1) for side in (-1.0, 1.0)])
        scores = self.rng.normal(0.0, self.spread, (len(image), 2))
        return np.repeat(plans[None], len(image), 0).astype(np.float32), scores


def sides(planner, remember: bool, noise: float = 0.01) -> np.ndarray:
    """On which side of the pillar ahead each of 40 plans of a robot that hardly moves passes."""
    rng, occupancy = np.random.default_rng(0), map_with_pillars([(0.6, 0.0)])
    previous, chosen = np.full((1, 10, 2), np.nan), []
    for _ in range(40):
        where = rng.normal(0.0, noise, (1, 2))
        shown = previous if remember else np.full((1, 10, 2), np.nan)
        previous = planner.plan(PlanQuery(where, np.array([[1.2, 0.0]]), [occupancy], [VisitMap(occupancy)], shown))
        chosen.append(float(np.sign(previous[0, 5, 1])))
    return np.array(chosen)


def flips(chosen: np.ndarray) -> int:
    return int(np.count_nonzero(np.diff(chosen)))


def test_plans_of_equal_merit_do_not_flip_from_one_query_to_the_next() -> None:
    assert flips(sides(GoseloPlanner(Undecided(0.2)), remember=False)) > 10
    assert flips(sides(GoseloPlanner(Undecided(0.2)), remember=True)) == 0
    assert flips(sides(verified(0.1, GoseloPlanner(Undecided(0.2))), remember=True)) == 0


def test_a_much_better_score_is_a_cause_to_change_sides() -> None:
    assert flips(sides(GoseloPlanner(Undecided(3.0)), remember=True)) > 0


def test_the_shipped_network_keeps_to_its_side_of_obstacles(network: GoseloPlanner) -> None:
    """A robot that stands, with a pose that is 5 cm wrong, before the worlds' obstacles: plans end where they did."""
    changed = {True: 0, False: 0}
    for layout in layouts_of("pillar(3,3,25)", 180, 0.1):
        occupancy, goal = layout.occupancy(0.0), layout.goal[None]
        for remember in changed:
            rng, previous = np.random.default_rng(2), np.full((1, 10, 2), np.nan)
            for _ in range(8):
                where = layout.start[None, :2] + rng.normal(0.0, 0.05, (1, 2))
                shown = previous if remember else np.full((1, 10, 2), np.nan)
                plan = network.plan(PlanQuery(where, goal, [occupancy], [VisitMap(occupancy)], shown))
                changed[remember] += int(np.linalg.norm(plan[0, -1] - previous[0, -1]) > 0.3)
                previous = plan
    assert changed[False] > 10 and changed[True] <= changed[False] / 2


def test_the_distance_from_an_old_plan_is_that_of_what_is_left_of_it() -> None:
    old = np.stack([0.1 * np.arange(1, 11), np.zeros(10)], axis=-1)[None]
    aside, ahead = old + [0.0, 0.2], old + [0.5, 0.0]
    position = np.array([[0.5, 0.0]])
    apart = apart_from(old, position, np.stack([old[0], aside[0], ahead[0]])[None])
    np.testing.assert_allclose(apart[0, :2], [0.0, 0.2], atol=1e-9)
    assert apart[0, 2] < 0.02, "driven waypoints count no more"
    assert np.isnan(apart_from(np.full_like(old, np.nan), position, old[:, None])).all()


# mirrors and degenerate input


def test_a_mirrored_world_gives_the_expert_s_mirrored_plan() -> None:
    """Where two ways are as long as each other the grid decides; everywhere else plans are mirror images."""
    apart = []
    for layout in layouts_of("pillar(2,2,10)", 30, 0.1):
        ours = layout.occupancy(0.0)
        theirs = OccupancyMap(ours.occupied[:, ::-1].copy(), ours.resolution, ours.origin)
        here, goal, flip = layout.start[:2], layout.goal, np.array([-1.0, 1.0])
        planner = ShortestPathPlanner(0.1, 0.15)
        plan = planner.plan(query_of([here], [goal], ours))
        mirrored = planner.plan(query_of([here * flip], [goal * flip], theirs))
        apart.append(np.linalg.norm(plan - mirrored * flip, axis=-1).max())
    assert np.mean(np.array(apart) < 1e-6) >= 0.8


ALL_FREE, ALL_OCCUPIED = (
    map_with_pillars(half_size=(1.0, 1.0)),
    OccupancyMap(np.ones((40, 40), bool), origin=(-1.0, -1.0)),
)
ENCLOSED = map_with_pillars([(x, y) for x in (-0.3, 0.0, 0.3) for y in (-0.3, 0.0, 0.3) if x or y], (1.0, 1.0), 0.16)


@pytest.mark.parametrize("repair", [False, True])
@pytest.mark.parametrize(
    ("occupancy", "start", "goal"),
    [
        (ALL_FREE, (0.1, 0.1), (0.1, 0.1)),
        (ALL_FREE, (0.1, 0.1), (0.2, 0.1)),
        (ALL_FREE, (-0.9, -0.9), (0.9, 0.9)),
        (ALL_FREE, (5.0, 5.0), (0.0, 0.0)),
        (ALL_FREE, (0.0, 0.0), (5.0, 5.0)),
        (ALL_OCCUPIED, (0.0, 0.0), (0.5, 0.5)),
        (ENCLOSED, (0.0, 0.0), (0.8, 0.8)),
        (ENCLOSED, (0.8, 0.8), (0.0, 0.0)),
        (OccupancyMap(np.zeros((1, 1), bool)), (0.02, 0.02), (0.03, 0.02)),
        (OccupancyMap(np.ones((1, 1), bool)), (0.02, 0.02), (0.03, 0.02)),
    ],
    ids=["start = goal", "one cell", "all free", "start outside", "goal outside", "all occupied", "start enclosed",
         "goal enclosed", "one free pixel", "one occupied pixel"],
)  # fmt: skip
def test_every_planner_answers_degenerate_questions(network, occupancy, start, goal, repair: bool) -> None:
    """With a plan of ten waypoints or, if repair is on, possibly with none and a reason."""
    planner = verified(0.1, network) if repair else network
    plan = planner.plan(query_of([start], [goal], occupancy))
    assert plan.shape == (1, 10, 2)
    if not repair or np.isfinite(plan).all():
        assert np.isfinite(plan).all()
    else:
        assert planner.tally["refusals"] == 1 and sum(n for name, n in planner.tally.items() if "/" in name) == 1
    expert = ShortestPathPlanner(0.1).plan(query_of([start], [goal], occupancy))
    assert expert.shape == (1, 10, 2) and (np.isfinite(expert).all() or np.isnan(expert).all())
