"""Each reward term is what it says, and driving in circles does not pay."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hiernav.config import RewardConfig, load_config
from hiernav.nav import path
from hiernav.nav.occupancy import OccupancyMap, draw_discs, empty_map
from hiernav.nav.option import WaypointOption
from hiernav.nav.path import polyline
from hiernav.nav.planners import ShortestPathPlanner
from hiernav.sim.reward import TERMS, reward_terms, weighted_sum

DEFAULT = RewardConfig()
PAPER = load_config(None, ["skill.preset=paper"]).reward
BASELINE = load_config(None, ["skill.preset=baseline"]).reward
STRAIGHT = polyline(np.zeros((1, 2)), 0.1 * np.arange(1, 11)[None, :, None] * [1.0, 0.0])
NO = np.zeros(1, bool)
seeds = st.integers(0, 2**32 - 1)


def terms_of(
    before: object,
    after: object,
    config: RewardConfig = DEFAULT,
    line: np.ndarray = STRAIGHT,
    upright: float = 1.0,
    **events: bool,
) -> dict[str, float]:
    """The terms of one robot's step towards a goal at (2, 0)."""
    flags = {name: np.array([events.get(name, False)]) for name in ("collided", "reached", "left")}
    ends = (np.array([end], float) for end in (before, after))
    terms = reward_terms(config, *ends, line, np.array([[2.0, 0.0]]), **flags, upright=np.array([upright]))
    assert tuple(terms) == TERMS
    return {name: float(values[0]) for name, values in terms.items()}


def pillars(*centers: tuple[float, float]) -> OccupancyMap:
    field = empty_map((3.0, 3.0))
    draw_discs(field.occupied, field.origin, field.resolution, np.array(centers).reshape(-1, 2), 0.2)
    return field


def earned_on_a_tour(config: RewardConfig, corners: object, occupancy: OccupancyMap, rounds: int = 4) -> np.ndarray:
    """Reward of each round of a closed tour in steps of 0.05 m, with an expert that replans as its rule says."""
    corners = np.asarray(corners, float)
    tour = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = int(np.ceil(np.linalg.norm(b - a) / 0.05))
        tour += [a + (b - a) * k / count for k in range(count)]
    option, goal = WaypointOption(ShortestPathPlanner(radius=0.1, soft_margin=0.15), 1), np.array([[2.0, 0.0]])
    before = tour[0][None]
    option.step(before, goal, [occupancy])
    rewards = []
    for _ in range(rounds):
        total = 0.0
        for position in [*tour[1:], tour[0]]:
            after = position[None]
            terms = reward_terms(config, before, after, option.line(), goal, NO, NO, NO, np.ones(1))
            total += float(weighted_sum(config, terms)[0])
            option.step(after, goal, [occupancy])
            before = after
        rewards.append(total)
    return np.array(rewards)


# the terms


def test_standing_still_on_a_waypoint_is_worth_nothing_but_its_time() -> None:
    terms = terms_of((0.3, 0.0), (0.3, 0.0))
    assert terms.pop("time") == 1.0
    assert terms.pop("goal_distance") == pytest.approx(1.7)
    assert terms == pytest.approx(dict.fromkeys(terms, 0.0), abs=1e-12)


def test_no_row_depends_on_how_far_the_others_moved() -> None:
    line = np.stack([np.linspace(0.0, 1.0, 11), np.zeros(11)], axis=-1)[None]
    vertices = path.divide(np.repeat(line, 3, axis=0), 0.1)
    before, after = np.zeros((3, 2)), np.array([[0.1, 0.0], [0.37, 0.0], [np.nan, 0.0]])
    together = path.path_distance(before, after, vertices, 0.1)
    alone = [path.path_distance(before[i, None], after[i, None], vertices[i, None], 0.1)[0] for i in range(3)]
    np.testing.assert_array_equal(together, alone)
    assert together[0] == pytest.approx(0.0, abs=1e-9), "both ends of this motion are vertices"


def test_path_distance_is_the_largest_distance_from_the_plan() -> None:
    assert terms_of((0.3, 0.2), (0.3, 0.1))["path_distance"] == pytest.approx(0.2)
    assert terms_of((0.25, 0.0), (0.25, 0.0))["path_distance"] == pytest.approx(0.05), "to vertices 0.1 m apart"


@pytest.mark.parametrize("config", [DEFAULT, PAPER])
def test_two_waypoints_forward_are_a_progress_of_two_and_back_again_of_minus_two(config: RewardConfig) -> None:
    assert terms_of((0.1, 0.0), (0.3, 0.0), config)["progress"] == pytest.approx(2.0)
    assert terms_of((0.3, 0.0), (0.1, 0.0), config)["progress"] == pytest.approx(-2.0)


def test_the_paper_counts_whole_waypoints_and_the_default_measures() -> None:
    assert terms_of((0.0, 0.0), (0.04, 0.0), PAPER)["progress"] == 0.0
    assert terms_of((0.0, 0.0), (0.06, 0.0), PAPER)["progress"] == 1.0
    assert terms_of((0.0, 0.0), (0.04, 0.0), DEFAULT)["progress"] == pytest.approx(0.4)


def test_backing_off_a_fresh_plan_is_free_in_the_paper_and_costs_by_default() -> None:
    assert terms_of((0.0, 0.0), (-0.25, 0.0), PAPER)["progress"] == 0.0
    assert terms_of((0.0, 0.0), (-0.25, 0.0), DEFAULT)["progress"] == pytest.approx(-2.5)


def test_straying_sideways_costs_by_default_what_coming_back_pays() -> None:
    detour = 10 * (np.hypot(0.5, 0.2) - 0.5)
    assert terms_of((0.3, 0.0), (0.3, 0.2))["progress"] == pytest.approx(-detour)
    assert terms_of((0.3, 0.2), (0.3, 0.0))["progress"] == pytest.approx(detour)


@pytest.mark.parametrize(("event", "term"), [("collided", "collision"), ("reached", "goal"), ("left", "leave_field")])
def test_an_event_is_one_in_its_own_term_alone(event: str, term: str) -> None:
    terms, without = terms_of((0.1, 0.0), (0.2, 0.0), **{event: True}), terms_of((0.1, 0.0), (0.2, 0.0))
    assert terms == {**without, term: 1.0}


@pytest.mark.parametrize(
    ("upright", "tilt", "fall"), [(1.0, 0.0, 0.0), (0.8, 0.0, 0.0), (0.5, 0.3, 0.0), (-0.2, 1.0, 1.0)]
)
def test_a_tilted_body_is_charged_by_the_angle_and_one_on_its_back_once_more(
    upright: float, tilt: float, fall: float
) -> None:
    terms = terms_of((0.1, 0.0), (0.2, 0.0), upright=upright)
    assert terms == {**terms_of((0.1, 0.0), (0.2, 0.0)), "tilt": pytest.approx(tilt), "fall": fall}


# the weights


def test_the_reward_is_the_paper_s_weighted_sum() -> None:
    terms = {name: np.array([value]) for name, value in terms_of((0.1, 0.2), (0.3, 0.2), PAPER, collided=True).items()}
    assert weighted_sum(PAPER, terms)[0] == pytest.approx(-0.1 * np.hypot(0.2, 0.05) + 0.5 * 2 - 1.0, abs=0.001)
    terms = {name: np.array([value]) for name, value in terms_of((0.1, 0.0), (0.2, 0.0), PAPER, reached=True).items()}
    assert weighted_sum(PAPER, terms)[0] == pytest.approx(0.5 + 1.0)


def test_the_baseline_is_paid_for_goal_and_collision_and_charged_its_distance() -> None:
    terms = {name: np.array([value]) for name, value in terms_of((0.1, 0.4), (0.5, 0.0), BASELINE).items()}
    assert weighted_sum(BASELINE, terms)[0] == pytest.approx(-1.5)
    terms["collision"], terms["goal"] = np.array([1.0]), np.array([1.0])
    assert weighted_sum(BASELINE, terms)[0] == pytest.approx(-1.5)


@given(seeds)
def test_each_term_enters_with_its_own_weight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weights = dict(zip(TERMS, rng.normal(size=len(TERMS)).tolist(), strict=True))
    terms = {name: rng.normal(size=4) for name in TERMS}
    expected = sum(weights[name] * terms[name] for name in TERMS)
    np.testing.assert_allclose(weighted_sum(RewardConfig(**weights), terms), expected)


# the reward hole


@given(seeds, st.integers(2, 10))
def test_around_one_plan_no_closed_motion_earns_anything_by_default(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    start, heading = rng.uniform(-1, 1, 2), np.cumsum(rng.uniform(-0.8, 0.8, 10))
    plan = start + 0.1 * np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=-1), axis=0)
    tour = rng.normal(start, 0.4, (count, 2))
    steps = zip(tour, np.roll(tour, -1, axis=0), strict=True)
    terms = [terms_of(before, after, DEFAULT, polyline(start[None], plan[None])) for before, after in steps]
    assert sum(term["progress"] for term in terms) == pytest.approx(0.0, abs=1e-8)
    reward = sum(weighted_sum(DEFAULT, {**term, "goal": np.zeros(1)})[0] for term in terms)
    assert reward <= 1e-8, "and straying from the plan costs"


TOURS = {
    "to and fro": (pillars(), [(0.0, 0.0), (-0.9, 0.0)]),
    "across the way to the goal": (pillars(), [(1.05, -1.01), (0.61, 0.1)]),
    "around a pillar's corner": (pillars((0.6, 0.05)), [(0.34, 1.09), (0.31, 1.17), (0.34, 1.22), (0.1, 0.05)]),
    "around the end of a wall": (
        pillars((0.6, 0.05), (0.6, 0.45), (0.6, -0.35), (0.6, 0.85)),
        [(-0.63, 1.26), (0.33, 0.63)],
    ),
}


@pytest.mark.parametrize("tour", TOURS)
def test_a_tour_that_provokes_new_plans_earns_nothing_by_default(tour: str) -> None:
    occupancy, corners = TOURS[tour]
    assert (earned_on_a_tour(DEFAULT, corners, occupancy)[1:] <= 0.0).all()


def test_driving_to_and_fro_pays_without_end_in_the_paper() -> None:
    occupancy, corners = TOURS["to and fro"]
    paper = earned_on_a_tour(PAPER, corners, occupancy)
    assert (paper[1:] > 2.0).all()
    assert paper.sum() > 8.0 > 0.0 >= earned_on_a_tour(DEFAULT, corners, occupancy).sum()


@given(seeds)
@settings(max_examples=25)
def test_among_pillars_no_tour_earns_more_than_a_small_bound_by_default(seed: int) -> None:
    """Plans keep off obstacles at the price of length, so what they pay and the way they save differ a little.

    The bound is what one waypoint pays; the most that was seen in a thousand such tours is half of that.
    """
    rng = np.random.default_rng(seed)
    occupancy = pillars(*rng.uniform(-1.5, 1.5, (5, 2)))
    corners = rng.uniform(-1.5, 1.5, 2) + rng.uniform(-0.6, 0.6, (rng.integers(2, 5), 2))
    edges = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    assume(all(occupancy.is_free(np.linspace(a, b, 40), 0.1).all() for a, b in edges))
    assert earned_on_a_tour(DEFAULT, corners, occupancy, rounds=3)[1:].max() < 0.5
