"""filterpy's extended Kalman filter, without the second that its import spends on scipy.stats.

filterpy takes two distributions from scipy.stats, for plots and likelihoods that no estimator here uses. While it is
imported, stand-ins take their place, which fetch the real ones when they are called, so that a robot starts in half
the time.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class _Deferred:
    """The methods of a distribution of scipy.stats, which is imported on the first call."""

    def __init__(self, name: str, stand_in: ModuleType) -> None:
        self._name, self._stand_in = name, stand_in

    def __getattr__(self, method: str) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            if sys.modules.get("scipy.stats") is self._stand_in:
                return None  # filterpy's question, while it is imported, whether scipy knows an option; it does
            return getattr(getattr(import_module("scipy.stats"), self._name), method)(*args, **kwargs)

        return call


def _import_filter() -> Any:
    if "scipy.stats" not in sys.modules:
        stand_in = ModuleType("scipy.stats")
        for name in ("norm", "multivariate_normal"):
            setattr(stand_in, name, _Deferred(name, stand_in))
        sys.modules["scipy.stats"] = stand_in
        try:
            import_module("filterpy.kalman")
        except ImportError:  # a filterpy that takes other names gets all of scipy.stats below
            pass
        finally:
            del sys.modules["scipy.stats"]
    return import_module("filterpy.kalman").ExtendedKalmanFilter


ExtendedKalmanFilter = _import_filter()
