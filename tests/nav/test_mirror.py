"""A mirrored robot in a mirrored world does the mirrored thing: checked on the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiernav.nav.frames import world_to_body
from hiernav.nav.lidar import lidar_closeness
from hiernav.nav.mirror import mirror_of
from hiernav.nav.observation import CLOCK_HZ, ObservationTerm, clock_phase, observation_layout
from hiernav.sim.batch import BatchSim
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import ROBOTS, get_robot
from hiernav.sim.scene import scene_for
from hiernav.sim.worlds import sample_layout

STEPS = 12


def twin(layout, flip):
    """The layout reflected in the world plane that maps a point p to p * flip."""
    start = np.array([*(layout.start[:2] * flip), -layout.start[2]])
    return replace(layout, pillars=layout.pillars * flip, start=start, goal=layout.goal * flip)


@pytest.mark.parametrize("guidance", ["waypoints", "world_waypoints", "goal"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_mirrored_robot_sees_and_does_the_mirrored_thing(robot: str, guidance: str) -> None:
    spec, layout = get_robot(robot), get_robot(robot).observation_layout(guidance, clock=True)
    mirror = mirror_of(robot, layout)
    # a mirror in the world's x-z plane, or for a car in its y-z plane, turns yaw into -yaw
    flip = mirror.observation_sign[layout.slices["velocimeter"]][:2]
    world = sample_layout(parse_world("pillar(2,2,10)"), 3, spec.radius)
    worlds = [world, twin(world, flip)]
    sim = BatchSim(spec, 2, scene_for([world.spec]))
    sim.reset(np.arange(2), worlds)
    rng = np.random.default_rng(0)
    plan = world.start[:2] + np.cumsum(rng.normal(0.0, 0.1, (10, 2)), axis=0)

    def observe() -> np.ndarray:
        plans = np.stack([plan, plan * flip])
        goals = np.stack([w.goal for w in worlds])
        discs = np.stack([w.obstacle_discs(0.0) for w in worlds])
        values = {
            **sim.sensors,
            "lidar": lidar_closeness(sim.pose, discs),
            "waypoints": world_to_body(plans, sim.pose).reshape(2, -1),
            "world_waypoints": plans.reshape(2, -1),
            "goal": world_to_body(goals[:, None], sim.pose)[:, 0],
            # the left and the right legs step in turn: the twin's clock goes half a period behind
            "clock": clock_phase(sim.time + np.array([0.0, 0.5 / CLOCK_HZ])),
        }
        return layout.build(values)

    for _ in range(STEPS):
        action = rng.uniform(-1.0, 1.0, spec.action_dim)
        sim.step(np.stack([action, mirror.action(action)]))
        seen, mirrored = observe()
        np.testing.assert_allclose(mirrored, mirror.observation(seen), atol=2e-4)
    assert np.abs(seen).max() > 0.1


@pytest.mark.parametrize("robot", ROBOTS)
def test_mirroring_twice_changes_nothing(robot: str) -> None:
    layout = get_robot(robot).observation_layout()
    mirror = mirror_of(robot, layout)
    seen = np.random.default_rng(0).normal(size=(5, layout.size)).astype(np.float32)
    action = np.random.default_rng(1).normal(size=(5, len(mirror.action_index)))
    np.testing.assert_array_equal(mirror.observation(mirror.observation(seen)), seen)
    np.testing.assert_array_equal(mirror.action(mirror.action(action)), action)


def test_an_unknown_robot_has_no_mirror() -> None:
    with pytest.raises(ValueError, match="hovercraft"):
        mirror_of("hovercraft", get_robot("point").observation_layout())


def test_a_mirror_of_another_size_than_its_term_is_refused() -> None:
    """A leg more or less would otherwise move every value behind it."""
    short = observation_layout([ObservationTerm("joint_sin", 8, "", 1.0)])
    with pytest.raises(ValueError, match="'joint_sin' has 8 values, its mirror 12"):
        mirror_of("doggo", short)
