"""The view from above: a still picture of the field, and on it what moves, redrawn for every frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hiernav.draw import COLLISION, EDGE, GOAL, GREMLIN, OBSTACLE, PATH, PLAN, field_picture
from hiernav.nav.lidar import LIDAR_BINS, lidar_closeness, surface_distance
from hiernav.nav.opencv import cv2
from hiernav.nav.termination import TerminationReason
from hiernav.sim.layout import GREMLIN_HALF_SIZE
from hiernav.sim.outline import Outlines
from hiernav.sim.task import NavigationTask, TaskStep

Frame = NDArray[np.uint8]
"""(H, W, 3) RGB."""

REPLAN_COLORS = {
    TerminationReason.START: "#1a202c",
    TerminationReason.D_UPDATE: "#c05621",
    TerminationReason.HALF_INDEX: "#319795",
    TerminationReason.INVALID: "#b83280",
}
"""Of what is marked. A plan that is outdated is not: where obstacles move, one is every few steps."""
LIDAR = "#d69e2e"
COLORS = (COLLISION, EDGE, GOAL, GREMLIN, LIDAR, OBSTACLE, PATH, PLAN, *REPLAN_COLORS.values())
"""Of everything that may appear in a film."""
_LIDAR_RANGE = 3.0  # [m], drawn at most
_SHIFT = 4  # cv2 takes fixed-point coordinates with so many binary digits


class TopView:
    """The episode that row 0 of a task is in; an arrow shows the robot's heading, the x axis of its body.

    Args:
        task: its layout is drawn when an episode begins.
        long_side: of the picture [pixels].
        lidar: whether to draw what the lidar reads.
    """

    def __init__(self, task: NavigationTask, long_side: int, lidar: bool = False) -> None:
        self._task, self._lidar = task, lidar
        self._long_side = long_side
        self._outlines = Outlines(task.sim.model)

    def begin(self) -> None:
        """A new episode: draw its field, without trail or marks."""
        layout = self._task.layouts[0]
        self._field = field_picture(layout, self._long_side)
        self._canvas = np.ascontiguousarray(self._field.pixels)
        self._last = layout.start[:2]

    def follow(self, step: TaskStep) -> None:
        """Extend the trail by one control step, and mark where it collided or the robot got a new plan."""
        here = self._task.pose[0, :2]
        if not np.isfinite(here).all():
            return
        _lines(self._canvas, [self._pixels([self._last, here])], PATH, 2)
        self._last = here
        reason = TerminationReason(int(step.option.reason[0]))
        if reason in REPLAN_COLORS:
            self._mark(here, REPLAN_COLORS[reason], cv2.MARKER_DIAMOND)
        if step.collided[0]:
            self._mark(here, COLLISION, cv2.MARKER_TILTED_CROSS)

    def frame(self, step: TaskStep) -> Frame:
        """The present state over all that has been followed."""
        picture = self._canvas.copy()
        time = float(self._task.sim.time[0])
        for center in self._task.layouts[0].gremlin_positions(time):
            corners = center + GREMLIN_HALF_SIZE * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
            _polygon(picture, self._pixels(corners), GREMLIN, EDGE)
        if not np.isfinite(self._task.pose[0]).all():
            return picture
        if self._lidar:
            self._draw_lidar(picture, time)
        plan = self._pixels(np.concatenate([step.option.start[:1], step.plan[0]]))
        _lines(picture, [plan], PLAN, 1)
        for point in plan[1:]:
            cv2.circle(picture, point.tolist(), 3 << _SHIFT, rgb(PLAN), cv2.FILLED, cv2.LINE_AA, _SHIFT)
        self._draw_robot(picture, bool(step.collided[0]))
        return picture

    def _draw_robot(self, picture: Frame, collided: bool) -> None:
        for outline in self._outlines(self._task.sim.datas[0]):
            _polygon(picture, self._pixels(outline), COLLISION if collided else PATH, EDGE)
        position, yaw = self._task.pose[0, :2], self._task.pose[0, 2]
        ahead = 1.8 * self._task.robot.radius * np.array([np.cos(yaw), np.sin(yaw)])
        tail, head = np.round(self._field.pixel_of([position, position + ahead])).astype(int).tolist()
        cv2.arrowedLine(picture, tail, head, rgb("#ffffff"), 3, cv2.LINE_AA, tipLength=0.3)
        cv2.arrowedLine(picture, tail, head, rgb(EDGE), 1, cv2.LINE_AA, tipLength=0.3)

    def _draw_lidar(self, picture: Frame, time: float) -> None:
        """One fan a sector, out to the distance of what the sector sees."""
        pose = self._task.pose[:1]
        closeness = lidar_closeness(pose, self._task.layouts[0].obstacle_discs(time)[None])[0]
        distance = np.minimum(surface_distance(closeness), _LIDAR_RANGE)
        fans = picture.copy()
        for sector in range(LIDAR_BINS):
            bearings = pose[0, 2] + 2.0 * np.pi / LIDAR_BINS * (sector + np.linspace(0.05, 0.95, 8))
            arc = pose[0, :2] + distance[sector] * np.column_stack([np.cos(bearings), np.sin(bearings)])
            _polygon(fans, self._pixels(np.concatenate([pose[:, :2], arc])), LIDAR, LIDAR)
        cv2.addWeighted(fans, 0.25, picture, 0.75, 0.0, dst=picture)

    def _mark(self, where: NDArray[np.float64], color: str, kind: int) -> None:
        column, row = np.round(self._field.pixel_of(where)).astype(int).tolist()
        cv2.drawMarker(self._canvas, (column, row), rgb("#ffffff"), kind, 12, 5, cv2.LINE_AA)
        cv2.drawMarker(self._canvas, (column, row), rgb(color), kind, 10, 2, cv2.LINE_AA)

    def _pixels(self, points: ArrayLike) -> NDArray[np.int32]:
        """World (K, 2) [m] -> fixed-point pixels for cv2, whose whole numbers are the centres of pixels."""
        return np.round((self._field.pixel_of(points) - 0.5) * (1 << _SHIFT)).astype(np.int32)


def rgb(color: str) -> tuple[int, int, int]:
    """ "#rrggbb" as three numbers."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def _polygon(picture: Frame, points: NDArray[np.int32], fill: str, edge: str) -> None:
    cv2.fillPoly(picture, [points], rgb(fill), cv2.LINE_AA, _SHIFT)
    cv2.polylines(picture, [points], True, rgb(edge), 1, cv2.LINE_AA, _SHIFT)


def _lines(picture: Frame, lines: list[NDArray[np.int32]], color: str, width: int) -> None:
    cv2.polylines(picture, lines, False, rgb(color), width, cv2.LINE_AA, _SHIFT)
