"""What plans take for free, asked of the physics: the map is a picture of the world, in pixels of 5 cm."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from hiernav.nav.search import PathField
from hiernav.sim.batch import BatchSim
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.robots import get_robot
from hiernav.sim.scene import scene_for
from hiernav.sim.worlds import sample_layout

POINT = get_robot("point")
PIXELATION = 0.03
"""How far an obstacle reaches beyond what the map shows of it, at most [m]."""


def depths(layout: Layout, places: np.ndarray) -> np.ndarray:
    """How deep the point robot's ball is in obstacles at places (M, 2) [m]; 0 where it touches none.

    The box that shows its heading reaches 5 cm beyond the disc that plans are made for.
    """
    sim = BatchSim(POINT, len(places), scene_for([layout.spec]))
    starts = np.column_stack([places, np.zeros(len(places))])
    sim.reset(np.arange(len(places)), [replace(layout, start=start) for start in starts])
    found = np.zeros(len(places))
    for row, data in enumerate(sim.datas):
        for contact in data.contact:
            names = {mujoco.mj_id2name(sim.model, mujoco.mjtObj.mjOBJ_GEOM, geom) for geom in contact.geom.tolist()}
            if "robot" in names and any(name and name.startswith(("pillar", "gremlin", "brick")) for name in names):
                found[row] = max(found[row], -contact.dist)
    return found


@pytest.mark.parametrize("world", ["pillar(2,2,10)", "gremlin", "two-room", "four-room"])
@pytest.mark.parametrize("seed", range(2))
def test_a_robot_that_is_placed_along_a_shortest_path_touches_nothing(world, seed):
    layout = sample_layout(parse_world(world), seed, POINT.radius)
    field = PathField(layout.occupancy(0.0), layout.goal, POINT.radius)
    path = field.smooth(field.path_from(layout.start[:2]))
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    stations = np.arange(0.0, arc[-1], 0.02)
    places = np.stack([np.interp(stations, arc, path[:, axis]) for axis in range(2)], axis=1)
    assert len(places) > 40 and depths(layout, places).max() < PIXELATION


@pytest.mark.parametrize("world", ["pillar(2,2,10)", "two-room"])
def test_map_and_physics_agree_on_where_a_robot_fits(world):
    layout = sample_layout(parse_world(world), 3, POINT.radius)
    places = np.random.default_rng(0).uniform(-1.8, 1.8, (300, 2))
    room, depth = layout.occupancy(0.0).clearance_at(places), depths(layout, places)
    assert not (depth[room >= POINT.radius] >= PIXELATION).any()
    tight = room < POINT.radius - PIXELATION
    assert tight.sum() > 10 and (depth[tight] > 0.0).all()
