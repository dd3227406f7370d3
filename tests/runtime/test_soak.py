"""Claims about a long run under random faults: no command breaks a limit, no mode is entered that may not be."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest
from soak import soak

from hiernav.runtime.supervisor import Mode


@pytest.fixture(autouse=True)
def quiet() -> None:
    logging.disable(logging.CRITICAL)  # the faults of the skill are logged with their tracebacks
    yield
    logging.disable(logging.NOTSET)


def resident_megabytes() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_ten_thousand_ticks_break_no_rule_and_visit_every_mode():
    rules = soak(10_000, seed=1)
    assert rules.broken is None
    assert all(rules.modes[mode] > 0 for mode in Mode), rules.modes


def test_the_same_seed_gives_the_same_log():
    assert soak(2_000, seed=2).digest.digest() == soak(2_000, seed=2).digest.digest()
    assert soak(2_000, seed=2).digest.digest() != soak(2_000, seed=3).digest.digest()


@pytest.mark.slow
def test_a_million_ticks_break_no_rule_and_take_no_memory():
    soak(20_000, seed=0)
    before = resident_megabytes()
    rules = soak(1_000_000, seed=0)
    assert rules.broken is None and rules.ticks >= 1_000_000
    grown = resident_megabytes() - before
    print(f"{grown:.2f} MB more after 10^6 ticks ({rules.ticks * 0.02 / 3600:.1f} h at 50 Hz)", rules.modes)
    assert grown <= 1_000_000 * 0.02 / 3600  # 1 MB an hour
