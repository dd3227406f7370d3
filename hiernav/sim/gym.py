"""The navigation task as a Gymnasium environment; `hiernav.envs` registers it."""

from __future__ import annotations

from typing import Any

import gymnasium
import msgspec
import numpy as np

from hiernav.config import TrainConfig, load_config
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.opencv import cv2
from hiernav.nav.option import Planner
from hiernav.nav.termination import TerminationReason
from hiernav.sim.factory import make_task
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.task import NavigationTask
from hiernav.sim.worlds import sample_layout

FRAME = 480
"""Longer side of a rendered image [px]."""


class NavigationGymEnv(gymnasium.Env):
    """One robot that is guided through sampled worlds.

    Observation: (D,) float32, raw SI units, in the order of `task.layout`. Action: (A,) float32 in [-1, 1]. An episode
    terminates at the goal or outside the field and is truncated at the world's cap on steps. `reset(seed=...)`
    determines the worlds of all episodes that follow. `info` holds the reward terms before their weights, `reached`,
    `left_field`, `collided`, the option's `reason`, the world's `layout_seed` and the robot's `pose`.

    Args:
        robot: "point", "car" or "doggo".
        world: any text that `parse_world` reads.
        planner: guides the robot; the shortest-path expert by default.
        config: rewards, option and kind of guidance. Its robot and its world are replaced by the two above, and
            episodes end as evaluations do: `skill.episode_steps` and `skill.end_on_fall` are for training alone.
        render_mode: None or "rgb_array", the world from above.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}

    def __init__(
        self,
        robot: str = "point",
        world: str = "pillar(2,2,10)",
        planner: Planner | None = None,
        config: TrainConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode {render_mode!r}; accepted: None, {', '.join(self.metadata['render_modes'])}")
        self.render_mode = render_mode
        self._world = parse_world(world)
        config = msgspec.structs.replace(config or load_config(), robot=robot)
        self.task: NavigationTask = make_task(config, 1, planner, [self._world], layouts=self._draw)
        self.metadata = self.metadata | {"render_fps": round(1.0 / self.task.robot.control_period)}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (self.task.layout.size,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (self.task.robot.action_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode in a new world, or in `options["layout"]`."""
        super().reset(seed=seed)
        layout = (options or {}).get("layout")
        observation = self.task.reset(layouts=None if layout is None else [layout])
        return observation[0], self._info(TerminationReason.START)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step."""
        step = self.task.step(np.asarray(action)[None])
        info = self._info(TerminationReason(step.option.reason[0])) | {
            "terms": {name: float(values[0]) for name, values in step.terms.items()},
            "reached": bool(step.reached[0]),
            "left_field": bool(step.left[0]),
            "collided": bool(step.collided[0]),
        }
        return step.observation[0], float(step.reward[0]), bool(step.terminated[0]), bool(step.truncated[0]), info

    def render(self) -> np.ndarray | None:
        """(H, W, 3) uint8, the world from above with the robot's plan; None without a render mode."""
        if self.render_mode is None:
            return None
        layout, pose = self.task.layouts[0], self.task.pose[0]
        if layout is None:
            raise gymnasium.error.ResetNeeded("render() before reset(): there is no world yet")
        return draw_from_above(layout, float(self.task.sim.time[0]), pose, self.task.robot.radius, self.task.plan[0])

    def close(self) -> None:
        self.task.sim.close()

    def _draw(self, row: int) -> Layout:
        return sample_layout(self._world, int(self.np_random.integers(2**31)), self.task.robot.radius)

    def _info(self, reason: TerminationReason) -> dict[str, Any]:
        return {
            "reason": reason.name.lower(),
            "layout_seed": self.task.layouts[0].seed,
            "pose": self.task.pose[0].copy(),
        }


def draw_from_above(layout: Layout, time: float, pose: np.ndarray, radius: float, plan: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB: map, goal, plan (K, 2) and robot at pose (3,); +y is up."""
    occupied = np.flipud(layout.occupancy(time).occupied)
    xmin, xmax, ymin, ymax = layout.extent
    scale = FRAME / max(xmax - xmin, ymax - ymin)
    size = max(1, round(scale * (xmax - xmin))), max(1, round(scale * (ymax - ymin)))
    image = cv2.resize(np.where(occupied, 90, 245).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)

    def pixel(point: np.ndarray) -> tuple[int, int]:
        # far outside the field all places look alike, and OpenCV takes no larger numbers
        at = np.clip(np.nan_to_num([point[0] - xmin, ymax - point[1]]) * scale, -FRAME, 2 * FRAME)
        return int(at[0]), int(at[1])

    cv2.circle(image, pixel(layout.goal), round(GOAL_RADIUS * scale), (90, 180, 90), -1, cv2.LINE_AA)
    for waypoint in plan:
        cv2.circle(image, pixel(waypoint), 3, (40, 90, 220), -1, cv2.LINE_AA)
    nose = pose[:2] + radius * np.array([np.cos(pose[2]), np.sin(pose[2])])
    cv2.circle(image, pixel(pose), max(2, round(radius * scale)), (220, 60, 40), -1, cv2.LINE_AA)
    cv2.line(image, pixel(pose), pixel(nose), (255, 255, 255), 2, cv2.LINE_AA)
    return image
