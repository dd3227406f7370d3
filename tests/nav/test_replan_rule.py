"""The rule by which a plan ends: each condition, its threshold, and which of several is the reason."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.nav.termination import ReplanRule, TerminationReason

NONE, START, D_UPDATE, HALF_INDEX, INVALID, GOAL, OUTDATED = TerminationReason
DEFAULT = ReplanRule()


def reason_of(rule: ReplanRule = DEFAULT, **values: object) -> TerminationReason:
    """What the rule says of one robot that is well on its plan, but for the values given."""
    row: dict[str, object] = {"distance": 0.0, "index": 0, "age": 1, "at_goal": False, "started": True}
    row |= {"blocked": False, "outdated": False} | values
    columns = {name: np.array([value]) for name, value in row.items()}
    distance, index = columns.pop("distance"), columns.pop("index")
    return TerminationReason(rule(distance, index, 10, **columns)[0])


def test_a_robot_on_its_plan_goes_on() -> None:
    assert reason_of() == NONE


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"started": False}, START),
        ({"at_goal": True}, GOAL),
        ({"blocked": True}, INVALID),
        ({"distance": 0.31}, D_UPDATE),
        ({"index": 6}, HALF_INDEX),
        ({"outdated": True}, OUTDATED),
    ],
)
def test_each_condition_alone_ends_the_plan(values: dict, reason: TerminationReason) -> None:
    assert reason_of(**values) == reason


def test_of_several_conditions_the_documented_first_one_is_the_reason() -> None:
    order = [
        ({"started": False}, START),
        ({"at_goal": True}, GOAL),
        ({"blocked": True}, INVALID),
        ({"distance": 9.0}, D_UPDATE),
        ({"index": 9}, HALF_INDEX),
        ({"outdated": True}, OUTDATED),
    ]
    for count in range(1, 7):
        for chosen in itertools.combinations(order, count):
            values = {key: value for condition, _ in chosen for key, value in condition.items()}
            assert reason_of(**values) == chosen[0][1], values


def test_a_distance_of_exactly_d_update_does_not_end_the_plan() -> None:
    assert reason_of(distance=0.3) == NONE
    assert reason_of(distance=np.nextafter(0.3, 1.0)) == D_UPDATE
    assert reason_of(ReplanRule(d_update=0.5), distance=0.5) == NONE


def test_the_middle_waypoint_does_not_end_the_plan_and_the_next_one_does() -> None:
    assert reason_of(index=5) == NONE
    assert reason_of(index=6) == HALF_INDEX
    assert reason_of(ReplanRule(half_fraction=1.0), index=10) == NONE


def test_a_distance_that_is_not_a_number_counts_as_too_far() -> None:
    assert reason_of(distance=np.nan) == D_UPDATE
    assert reason_of(ReplanRule(period=8), distance=np.nan) == D_UPDATE


def test_without_invalid_a_blocked_or_outdated_plan_goes_on() -> None:
    assert reason_of(ReplanRule(invalid=False), blocked=True) == NONE
    assert reason_of(ReplanRule(invalid=False), outdated=True) == NONE


def test_a_fixed_period_is_not_cut_short_because_the_map_has_changed() -> None:
    assert reason_of(ReplanRule(period=8), age=7, outdated=True) == NONE
    assert reason_of(ReplanRule(period=8), age=8, outdated=True) == HALF_INDEX


def test_a_fixed_period_is_cut_short_by_what_is_in_the_way_and_by_the_goal() -> None:
    assert reason_of(ReplanRule(period=8), age=7, blocked=True) == INVALID
    assert reason_of(ReplanRule(period=8), age=7, at_goal=True) == GOAL
    assert reason_of(ReplanRule(period=8, invalid=False), age=7, blocked=True) == NONE


@given(st.floats(0.0, 5.0), st.integers(0, 10), st.integers(0, 40))
def test_with_a_period_neither_distance_nor_index_matters(distance: float, index: int, age: int) -> None:
    expected = HALF_INDEX if age >= 16 else NONE
    assert reason_of(ReplanRule(period=16), distance=distance, index=index, age=age) == expected


@given(st.data())
def test_a_batch_is_ruled_row_by_row(data: st.DataObject) -> None:
    rule = data.draw(st.builds(ReplanRule, invalid=st.booleans(), period=st.sampled_from([None, 4])))
    flags = {name: st.booleans() for name in ("blocked", "outdated", "at_goal", "started")}
    numbers = {
        "distance": st.sampled_from([0.0, 0.3, 0.4, np.nan]),
        "index": st.integers(0, 10),
        "age": st.integers(0, 9),
    }
    rows = data.draw(st.lists(st.fixed_dictionaries(numbers | flags), min_size=1, max_size=6))
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    got = rule(columns.pop("distance"), columns.pop("index"), 10, **columns)
    assert [TerminationReason(r) for r in got] == [reason_of(rule, **row) for row in rows]
