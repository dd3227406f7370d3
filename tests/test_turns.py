"""Contenders in processes of their own."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from turns import Skipped, Turns

TOOLS = Path(__file__).parents[1] / "tools"


@pytest.fixture
def child(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TOOLS), *sys.path]))
    return lambda code: Turns([sys.executable, "-c", code])


def test_a_child_counts_for_as_long_as_it_is_asked_and_whatever_its_libraries_print(child):
    contender = child("from turns import take_turns; print('welcome'); take_turns(lambda: print('\\nstep', 1) or 2)")
    (count, spent), (none, _) = contender(0.01), contender(0.0)
    contender.close()
    assert count > 0 and count % 2 == 0 and spent >= 0.01 and none == 0


def test_a_child_that_dies_in_its_turn_is_named(child):
    contender = child("from turns import take_turns; take_turns(lambda: 1 // 0)")
    with pytest.raises(RuntimeError, match="take_turns.* has ended with code 1"):
        contender(0.01)
    contender.close()


def test_a_python_that_is_not_there_is_skipped():
    with pytest.raises(Skipped, match="^/nope: No such file or directory$"):
        Turns(["/nope", "-c", "pass"])


@pytest.mark.parametrize(("code", "why"), [("print('skip no such thing')", "no such thing"), ("", "it ended")])
def test_a_child_that_cannot_run_says_why(child, code, why):
    with pytest.raises(Skipped, match=f"^{why}$"):
        child(code)
