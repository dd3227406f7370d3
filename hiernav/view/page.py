"""The live page: a viser scene of what the control loop shows, with buttons that ask it for something."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime.estimate import Estimate
from hiernav.runtime.observe import Event, TickRecord
from hiernav.view import shapes
from hiernav.view.commands import Command, Settings

HOST = "127.0.0.1"
"""Nobody but this machine: whoever can open the page can move the robot."""
WALL_HEIGHT = 0.25
ROBOT_HEIGHT = 0.16
TRAIL_LENGTH, TRAIL_STEP = 2000, 0.02
"""Points of the driven path that are kept, and their distance [m]."""
TEXT_EVERY = 5
"""Ticks shown between two updates of the text."""
MAP, ROBOT, TRUTH, PLAN, GOAL, TRAIL, LIDAR, ELLIPSE = (
    (110, 118, 130), (31, 98, 196), (70, 170, 90), (225, 120, 30), (200, 40, 60), (60, 60, 70), (150, 90, 200),
    (255, 205, 40),
)  # fmt: skip


class Page:
    """Scene and panel. Not safe to call from several threads at a time."""

    def __init__(self, settings: Settings, ask: Callable[[Command], None]) -> None:
        """
        Args:
            settings: what the page is for.
            ask: called, from any thread, with what somebody did on the page.
        """
        self.settings, self._ask = settings, ask
        self.server = viser.ViserServer(HOST, settings.port, label=settings.title, verbose=False)
        self.url = f"http://{HOST}:{self.server.get_port()}"
        self._map: OccupancyMap | None = None
        self._seen: dict[str, Any] = {}
        self._trail: deque[np.ndarray] = deque(maxlen=TRAIL_LENGTH)
        self._lateness: deque[float] = deque(maxlen=400)
        self._sections: dict[str, deque[float]] = {}
        self._last: tuple[int, float] | None = None
        self._rate = 0.0
        self._shown = 0
        self._began: float | None = None
        self._events: deque[str] = deque(maxlen=12)
        self._make_scene()
        self._make_panel()

    def show(self, record: TickRecord) -> None:
        """Draw a tick."""
        if record.occupancy is not None and record.occupancy is not self._map:
            self._show_map(record.occupancy)
        estimate, truth = record.estimate, record.truth
        self._place("/robot", None if estimate is None else estimate.pose)
        self._place("/truth", None if truth is None else truth.pose)
        self._show_trail(estimate if truth is None else truth)
        with_ellipse = estimate is not None and record.occupancy is not None
        self._lines("/ellipse", _ellipse(estimate) if with_ellipse and estimate else None, ELLIPSE, 0.012)
        arcs = None
        if estimate is not None and record.frame.lidar is not None:
            arcs = shapes.lidar_arcs(estimate.pose, record.frame.lidar, 0.03)
        self._lines("/lidar", arcs, LIDAR, 0.015)
        self._show_plan(record)
        goal = None if record.goal is None else shapes.circle(record.goal, self.settings.goal_radius)
        self._lines("/goal", None if goal is None else shapes.segments(goal, 0.02, closed=True), GOAL, 0.03)
        self._count(record)
        if self._shown % TEXT_EVERY == 0:
            self._state.content = self._state_text(record)
            self._timing.content = self._timing_text()
        self._shown += 1

    def tell(self, event: Event) -> None:
        """Note an event in the panel, by the time since the first one."""
        self._began = event.time if self._began is None else self._began
        self._events.append(f"{event.time - self._began:.1f} s: {event.kind} {event.text}")
        self._log.content = "\n".join(f"- {_plain(line)}" for line in reversed(self._events))
        if event.kind == "mode" and event.values.get("mode") in ("init", "armed"):
            self._trail.clear()

    def stop(self) -> None:
        self.server.stop()

    def _make_scene(self) -> None:
        scene, radius = self.server.scene, self.settings.robot_radius
        scene.set_up_direction("+z")
        # Pictures of surroundings would come from the internet, and shadows take longer than all the rest.
        scene.configure_environment_map(None)
        scene.configure_default_lights(cast_shadow=False)
        scene.add_light_ambient("/light", intensity=1.5)
        for name, color, wide, high in (("/truth", TRUTH, 1.2, 0.3), ("/robot", ROBOT, 1.0, 1.0)):
            scene.add_frame(name, show_axes=False, visible=False)
            height = high * ROBOT_HEIGHT
            scene.add_cylinder(f"{name}/body", wide * radius, height, color=color, position=(0.0, 0.0, 0.5 * height))
        vertices, faces = shapes.arrow(radius, ROBOT_HEIGHT)
        scene.add_mesh_simple("/robot/heading", vertices, faces, color=(255, 255, 255), side="double")

        @scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            point = on_floor(event.ray_origin, event.ray_direction)
            if point is not None:
                self._ask(Command("goal", *point))

    def _make_panel(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        self._state = gui.add_markdown("waiting for the first tick")
        gui.add_markdown("*Click on the floor to set the goal.*")
        for label, kind, color in (
            ("Pause", "pause", None), ("Resume", "resume", None), ("Cancel goal", "cancel", None),
            ("Emergency stop", "estop", "red"), ("Acknowledge fault", "acknowledge", None),
        ):  # fmt: skip
            # what a button asks for hangs on nothing that the page believes: others command the robot too
            button = gui.add_button(label, color=color)
            button.on_click(lambda _event, kind=kind: self._ask(Command(kind)))
        if self.settings.faults:
            with gui.add_folder("Inject a fault"):
                choice = gui.add_dropdown("fault", self.settings.faults)
                gui.add_button("Inject").on_click(lambda _event: self._ask(Command("fault", text=choice.value)))
        with gui.add_folder("Timing"):
            self._timing = gui.add_markdown("")
        with gui.add_folder("Events"):
            self._log = gui.add_markdown("")

    def _show_map(self, occupancy: OccupancyMap) -> None:
        first, self._map = self._map is None, occupancy
        vertices, faces = shapes.extruded(occupancy, WALL_HEIGHT)
        if len(faces):
            self.server.scene.add_mesh_simple("/map", vertices, faces, color=MAP, flat_shading=True, side="double")
        else:
            self.server.scene.remove_by_name("/map")
        xmin, xmax, ymin, ymax = occupancy.extent
        corners = np.array([[xmin, ymin], [xmax, ymin], [xmax, ymax], [xmin, ymax]])
        self._lines("/field", shapes.segments(corners, 0.0, closed=True), MAP, 0.02)
        if first:
            self._aim((0.5 * (xmin + xmax), 0.5 * (ymin + ymax)), max(xmax - xmin, ymax - ymin))

    def _aim(self, center: tuple[float, float], size: float) -> None:
        """Look at the whole field from above, a little from the south, and leave room for the panel on the right."""
        floor = self.server.scene.add_grid("/floor", size, size, cell_size=0.5, plane="xy", infinite_grid=False)
        floor.position = (*center, -0.005)
        aim = center[0] + 0.12 * size
        position, look_at = (aim, center[1] - 0.45 * size, 0.8 * size), (aim, center[1], 0.0)
        initial = self.server.initial_camera
        initial.position, initial.look_at, initial.up = position, look_at, (0.0, 0.0, 1.0)
        for client in self.server.get_clients().values():
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position, client.camera.look_at = position, look_at

    def _place(self, name: str, pose: np.ndarray | None) -> None:
        frame = self.server.scene.get_handle_by_name(name)
        assert frame is not None
        frame.visible = pose is not None
        if pose is not None:
            frame.position = (float(pose[0]), float(pose[1]), 0.0)
            frame.wxyz = (math.cos(0.5 * pose[2]), 0.0, 0.0, math.sin(0.5 * pose[2]))

    def _show_plan(self, record: TickRecord) -> None:
        plan = record.plan
        if plan is None or record.plan_start is None or not np.isfinite(plan).all():
            self._lines("/plan", None, PLAN, 0.03)
            self._lines("/waypoints", None, PLAN, 0.03)
            return
        line = np.vstack([record.plan_start, plan])
        self._lines("/plan", shapes.segments(line, 0.05), PLAN, 0.025)
        rings = [shapes.segments(shapes.circle(point, 0.03, 12), 0.05, closed=True) for point in plan]
        self._lines("/waypoints", np.concatenate(rings), PLAN, 0.02)

    def _show_trail(self, state: Any) -> None:
        if state is None:
            return
        here = np.asarray(state.pose[:2])
        if not self._trail or np.linalg.norm(here - self._trail[-1]) > TRAIL_STEP:
            self._trail.append(here)
        points = np.array(self._trail)
        self._lines("/path", shapes.segments(points, 0.015) if len(points) > 1 else None, TRAIL, 0.02)

    def _lines(self, name: str, points: np.ndarray | None, color: tuple[int, int, int], thickness: float) -> None:
        """Draw segments (S, 2, 3) under a name, in the place of those before; nothing if there are none."""
        if points is None or not len(points):
            if self._seen.pop(name, None) is not None:
                self.server.scene.remove_by_name(name)
        elif name not in self._seen or self._seen[name].shape != points.shape or (self._seen[name] != points).any():
            self._seen[name] = points
            self.server.scene.add_line_segments(name, points, np.array(color, np.uint8), thickness=thickness)

    def _count(self, record: TickRecord) -> None:
        self._lateness.append(record.lateness)
        for name, seconds in record.timings.items():
            self._sections.setdefault(name, deque(maxlen=400)).append(seconds)
        if self._last is not None and record.time > self._last[1]:
            rate = (record.index - self._last[0]) / (record.time - self._last[1])
            self._rate += 0.1 * (rate - self._rate) if self._rate else rate
        self._last = (record.index, record.time)

    def _state_text(self, record: TickRecord) -> str:
        lines = [f"**{record.mode.value}**"]
        if record.estimate is not None:
            x, y, yaw = record.estimate.pose.tolist()
            sigma = 3.0 * math.sqrt(max(record.estimate.covariance[0, 0], record.estimate.covariance[1, 1], 0.0))
            speed = math.hypot(*record.estimate.velocity)
            lines.append(f"position x {x:.2f} y {y:.2f} m ± {sigma:.2f}, heading {math.degrees(yaw):.0f}°")
            lines.append(f"speed {speed:.2f} m/s")
            if record.estimate.why:
                lines.append(f"estimate: {_plain(record.estimate.why)}")
        goal = "none" if record.goal is None else f"x {record.goal[0]:.2f} y {record.goal[1]:.2f} m"
        lines.append(f"goal {goal}")
        if record.plan_age is not None:
            lines.append(f"plan {record.plan_age:.2f} s old")
        if record.truth is not None:
            lines.append(f"collisions {record.truth.collisions}")
        return "  \n".join(lines)

    def _timing_text(self) -> str:
        rows = {"lateness": self._lateness, **self._sections}
        table = ["| ms | median | p99 | max |", "|---|---|---|---|"]
        for name, values in rows.items():
            times = np.array(values) * 1e3
            table.append(f"| {name} | {np.median(times):.2f} | {np.percentile(times, 99):.2f} | {times.max():.2f} |")
        return f"{self._rate:.0f} ticks/s\n\n" + "\n".join(table)


def on_floor(origin: tuple[float, float, float], direction: tuple[float, float, float]) -> tuple[float, float] | None:
    """Where a ray meets the floor (z = 0), world frame [m]; None if it does not."""
    if not direction[2] < -1e-6 or not origin[2] > 0.0:
        return None
    reach = -origin[2] / direction[2]
    return origin[0] + reach * direction[0], origin[1] + reach * direction[1]


def _ellipse(estimate: Estimate) -> np.ndarray:
    corners = shapes.ellipse(estimate.pose[:2], estimate.covariance[:2, :2])
    return shapes.segments(corners, ROBOT_HEIGHT + 0.02, closed=True)


def _plain(text: str) -> str:
    """Text that markdown shows as it is."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]<>()#+|~!" else c for c in text)
