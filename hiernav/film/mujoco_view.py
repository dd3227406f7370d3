"""The view through MuJoCo's own camera, which looks over the robot along +y. Needs an OpenGL back end."""

from __future__ import annotations

import sys
import traceback

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from hiernav.draw import FLOOR, GOAL, GREMLIN, OBSTACLE, PATH, PLAN
from hiernav.film.gl import no_gl
from hiernav.film.top_view import Frame, rgb
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.sim.task import NavigationTask, TaskStep

_DISTANCE = 12.0  # of the camera, in planning radii


class MujocoView:
    """Row 0 of a task, with its goal and its plan.

    Raises:
        ValueError: there is no OpenGL back end to draw with.
    """

    def __init__(self, task: NavigationTask, width: int, height: int) -> None:
        self._task, model = task, task.sim.model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        # obstacles that are not in use wait far away, and MuJoCo would measure its clipping planes by them
        model.stat.extent = 2.0
        _paint(model)
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # every back end fails in its own way
            _discard_what_failed(error)
            raise no_gl(error) from error
        self._camera = mujoco.MjvCamera()
        self._camera.azimuth, self._camera.elevation = 90.0, -35.0
        self._camera.distance = _DISTANCE * task.robot.radius

    def frame(self, step: TaskStep) -> Frame:
        """The present state (H, W, 3)."""
        task, scene = self._task, self._renderer.scene
        pose = task.pose[0]
        if np.isfinite(pose).all():
            self._camera.lookat = (pose[0], pose[1], task.robot.radius)
        self._renderer.update_scene(task.sim.datas[0], self._camera)
        _mark(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (*task.goal[0], 0.002), (GOAL_RADIUS, 0.002, 0.0), GOAL)
        for x, y in step.plan[0]:
            _mark(scene, mujoco.mjtGeom.mjGEOM_SPHERE, (x, y, 0.03), (0.02, 0.0, 0.0), PLAN)
        return self._renderer.render()

    def close(self) -> None:
        self._renderer.close()


def _discard_what_failed(error: Exception) -> None:
    """Collect what could not be made: the destructors of some releases of MuJoCo print a traceback then."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    cause: BaseException | None = error
    try:
        while cause is not None:
            traceback.clear_frames(cause.__traceback__)
            cause = cause.__cause__ or cause.__context__
    finally:
        sys.unraisablehook = before


def _paint(model: mujoco.MjModel) -> None:
    """Give everything the colours it has seen from above."""
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
    robot = model.body_rootid[model.geom_bodyid] == model.body("robot").id
    model.geom_rgba[:] = (*_unit(OBSTACLE), 1.0)
    for geom in range(model.ngeom):
        if model.geom(geom).name.startswith("gremlin"):
            model.geom_rgba[geom] = (*_unit(GREMLIN), 1.0)
    model.geom_rgba[robot] = (*_unit(PATH), 1.0)
    model.geom_rgba[model.geom("floor").id] = (*_unit(FLOOR), 1.0)


def _mark(scene: mujoco.MjvScene, kind: int, where: ArrayLike, size: ArrayLike, color: str) -> None:
    if scene.ngeom < scene.maxgeom:
        geom = scene.geoms[scene.ngeom]
        place, rgba = np.asarray(where, dtype=np.float64), np.array([*_unit(color), 1.0], dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.asarray(size, dtype=np.float64), place, np.eye(3).ravel(), rgba)
        scene.ngeom += 1


def _unit(color: str) -> tuple[float, ...]:
    return tuple(value / 255.0 for value in rgb(color))
