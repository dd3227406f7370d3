"""Layouts put together by hand, for tests that need to know where everything stands."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hiernav.nav.occupancy import OccupancyMap
from hiernav.sim.layout import Layout, WorldSpec


def layout_of(
    start: ArrayLike = (0.0, 0.0, 0.0),
    pillars: ArrayLike = (),
    gremlins: ArrayLike = (),
    walls: ArrayLike = (),
    half_size: tuple[float, float] = (2.0, 2.0),
    base_map: OccupancyMap | None = None,
) -> Layout:
    pillars = np.asarray(pillars, float).reshape(-1, 2)
    return Layout(
        spec=WorldSpec("pillar", *half_size, len(pillars), 300),
        seed=0,
        pillars=pillars,
        gremlins=np.asarray(gremlins, float).reshape(-1, 2),
        walls=np.asarray(walls, float).reshape(-1, 4),
        start=np.asarray(start, float),
        goal=np.array([1.5, 1.5]),
        base_map=base_map,
    )
