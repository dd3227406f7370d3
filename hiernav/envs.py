"""Registers the task with Gymnasium, so that `gymnasium.make("hiernav/PointPillar-v0")` works after `import hiernav`.

Names are robot and world: Point, Car or Doggo, then Pillar, Gremlin, TwoRoom or FourRoom; `world=` takes any other.
Nothing of the simulation is imported before an environment is made.
"""

from __future__ import annotations

import gymnasium

ROBOTS = {"Point": "point", "Car": "car", "Doggo": "doggo"}
WORLDS = {"Pillar": "pillar(2,2,10)", "Gremlin": "gremlin", "TwoRoom": "two-room", "FourRoom": "four-room"}

for _robot, _robot_name in ROBOTS.items():
    for _world, _world_name in WORLDS.items():
        gymnasium.register(
            id=f"hiernav/{_robot}{_world}-v0",
            entry_point="hiernav.sim.gym:NavigationGymEnv",
            kwargs={"robot": _robot_name, "world": _world_name},
        )
