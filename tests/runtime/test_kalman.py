"""The estimator's filter is filterpy's own, and its import leaves nothing behind."""

from __future__ import annotations

import subprocess
import sys


def in_a_fresh_interpreter(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.strip()


def test_importing_the_estimator_does_not_import_scipy_stats() -> None:
    assert (
        in_a_fresh_interpreter("import sys, hiernav.runtime.estimator; print('scipy.stats' in sys.modules)") == "False"
    )


def test_the_filter_is_filterpys_own_and_its_statistics_work_when_they_are_asked_for() -> None:
    code = (
        "from hiernav.runtime.kalman import ExtendedKalmanFilter as ours\n"
        "from filterpy.kalman import ExtendedKalmanFilter as theirs\n"
        "import filterpy.stats, scipy.stats\n"
        "print(ours is theirs, round(filterpy.stats.gaussian(1.0, 0.0, 1.0), 6),"
        " round(float(filterpy.stats.multivariate_gaussian([0.0], [0.0], [[1.0]])), 6),"
        " round(float(filterpy.stats.norm_cdf((-1.0, 1.0), 0.0, 1.0)), 4), scipy.stats.norm.cdf(0.0))"
    )
    assert in_a_fresh_interpreter(code) == "True 0.241971 0.398942 0.6827 0.5"


def test_a_process_that_has_scipy_stats_keeps_it() -> None:
    code = "import scipy.stats as s, sys, hiernav.runtime.kalman; print(sys.modules['scipy.stats'] is s)"
    assert in_a_fresh_interpreter(code) == "True"
