from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.runtime.supervisor import REASONS, TRANSITIONS, InvalidTransition, Mode, Supervisor


def supervisor_in(*path: Mode) -> Supervisor:
    supervisor = Supervisor()
    for mode in path:
        supervisor.change(mode, "test", 0.0)
    return supervisor


def test_a_run_goes_from_init_over_running_and_waiting_back_to_ready():
    path = (Mode.READY, Mode.ARMED, Mode.RUNNING, Mode.HOLD, Mode.RUNNING, Mode.RECOVERING, Mode.RUNNING, Mode.READY)
    assert supervisor_in(*path, Mode.INIT).mode is Mode.INIT


@given(st.lists(st.sampled_from(Mode), max_size=30))
def test_only_transitions_of_the_table_ever_happen(wishes):
    supervisor = Supervisor()
    for wish in wishes:
        before = supervisor.mode
        if wish in TRANSITIONS[before]:
            supervisor.change(wish, "test", 0.0)
            assert supervisor.mode is wish
        else:
            with pytest.raises(InvalidTransition, match=f"{before.name} -> {wish.name}"):
                supervisor.change(wish, "test", 0.0)
            assert supervisor.mode is before


def test_nothing_runs_that_was_not_armed():
    assert {mode for mode in Mode if Mode.RUNNING in TRANSITIONS[mode]} == {Mode.ARMED, Mode.HOLD, Mode.RECOVERING}
    for mode in (Mode.HOLD, Mode.RECOVERING):
        assert {each for each in Mode if mode in TRANSITIONS[each]} <= {Mode.RUNNING, Mode.RECOVERING}


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.ESTOP])
def test_a_fault_is_possible_anywhere_and_latches_with_its_reasons(mode):
    supervisor = Supervisor()
    supervisor.mode = mode
    if mode is Mode.FAULT:
        supervisor.mode = Mode.INIT
        supervisor.fail("first after 0.5 s", 0.5)
    assert not supervisor.fail("first after 0.5 s", 1.0)
    assert [supervisor.fail(why, 2.0) for why in ("second", "first after 0.75 s", "second")] == [True, False, False]
    assert (supervisor.mode, supervisor.fault) == (Mode.FAULT, "first after 0.5 s; second")
    assert supervisor.why == supervisor.fault
    assert sum(supervisor.fail("x" * k, 2.5) for k in range(1, 100)) == REASONS - 2
    for wish in set(Mode) - {Mode.ESTOP}:
        with pytest.raises(InvalidTransition):
            supervisor.change(wish, "test", 3.0)
    supervisor.acknowledge(4.0)
    assert (supervisor.mode, supervisor.fault) == (Mode.INIT, None)


@pytest.mark.parametrize("mode", list(Mode))
def test_an_emergency_stop_is_possible_anywhere_and_latches(mode):
    supervisor = Supervisor()
    supervisor.mode = Mode.INIT if mode is Mode.ESTOP else mode
    supervisor.stop("pressed", 1.0)
    supervisor.stop("pressed again", 2.0)
    assert (supervisor.mode, supervisor.fault) == (Mode.ESTOP, "pressed")
    assert supervisor.fail("something else", 3.0)
    assert (supervisor.mode, supervisor.fault) == (Mode.ESTOP, "pressed; something else")
    for wish in Mode:
        with pytest.raises(InvalidTransition):
            supervisor.change(wish, "test", 3.0)
    supervisor.acknowledge(4.0)
    assert (supervisor.mode, supervisor.fault) == (Mode.INIT, None)


@pytest.mark.parametrize("mode", list(Mode))
def test_only_running_and_recovering_drive(mode):
    supervisor = Supervisor()
    supervisor.mode = mode
    assert supervisor.driving == (mode in (Mode.RUNNING, Mode.RECOVERING))
    assert supervisor.latched == (mode in (Mode.FAULT, Mode.ESTOP))


def test_there_is_nothing_to_acknowledge_without_a_fault():
    with pytest.raises(InvalidTransition, match="no fault"):
        Supervisor().acknowledge(0.0)


def test_every_change_is_told_with_its_reason():
    told: list[tuple[float, Mode, str]] = []
    supervisor = Supervisor(lambda *change: told.append(change))
    supervisor.change(Mode.READY, "test", 0.0)
    supervisor.fail("pinned", 2.5)
    assert told == [(0.0, Mode.READY, "test"), (2.5, Mode.FAULT, "pinned")]
