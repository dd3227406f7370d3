"""Many simulations of one robot, stepped together.

All simulations share one compiled model. Each control step is one `mj_step` call per simulation, over all substeps;
MuJoCo releases the interpreter lock meanwhile, so that threads step their share of the rows side by side.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np

from hiernav.sim.layout import Layout
from hiernav.sim.robots import BASE_SENSORS, JointReader, RobotSpec
from hiernav.sim.scene import CONTACT_SENSORS, ObstaclePool, SceneSpec, build_model

STATE_LIMIT = 1e10
"""Positions and velocities beyond this count as not finite, as in MuJoCo's own check."""


class BatchSim:
    """`num_envs` simulations of `robot` in scenes of one kind; row i of every array is simulation i.

    Arrays published after each `reset` and `step`. They are new each time and never written again:
        pose (N, 3): x, y [m] and yaw [rad] in [-pi, pi), world frame.
        velocity (N, 2): of the body origin, world frame [m/s].
        upright (N,): z component of the body's z axis, 1 when it is upright.
        collided (N,) bool: the robot touched an obstacle in any substep of the last control step.
        sensors: name -> (N, d). accelerometer, velocimeter, gyro and magnetometer (3 each, body frame) and the robot's
            `own_terms`. Sensors of the model are those of the last substep as MuJoCo leaves them, that is of the state
            at that substep's start; everything else is of the present state.
        time (N,): since the row's reset [s].
        finite (N,) bool: False where the physics has diverged. Such a row reads NaN and stands still until it is reset.

    Contacts are found at the start of a substep. A contact that begins with the end of the last substep is therefore
    reported by the next control step.
    """

    pose: np.ndarray
    velocity: np.ndarray
    upright: np.ndarray
    collided: np.ndarray
    sensors: dict[str, np.ndarray]
    time: np.ndarray
    finite: np.ndarray

    def __init__(self, robot: RobotSpec, num_envs: int, scene: SceneSpec, threads: int = 1) -> None:
        """Build the scene and put every robot at the origin, without obstacles.

        `threads` is how many threads step the rows, the caller's included; it changes the speed and nothing else.
        Raises ValueError if `num_envs` or `threads` is below 1.
        """
        for name, value in (("num_envs", num_envs), ("threads", threads)):
            if value < 1:
                raise ValueError(f"BatchSim: {name} is {value}, it must be at least 1")
        self.robot = robot
        self.num_envs = num_envs
        self.scene = scene
        self.model = build_model(robot, scene)
        self._pool = ObstaclePool(scene)
        self._joints = JointReader(robot, self.model)
        self.datas = [mujoco.MjData(self.model) for _ in range(num_envs)]
        self._ctrl = [d.ctrl for d in self.datas]
        self._views = [[getattr(d, name) for d in self.datas] for name in ("qpos", "qvel", "sensordata", "history")]
        self._gremlins: dict[int, Layout] = {}
        sizes = dict.fromkeys(BASE_SENSORS, 3) | {term.name: term.size for term in robot.observed_sensors}
        self._sensor_columns = {name: self._sensor_values(name, size) for name, size in sizes.items()}
        self._contact_columns = [_history_values(self.model, name) for name in CONTACT_SENSORS]
        self._helpers = min(threads, num_envs) - 1
        self._workers = ThreadPoolExecutor(self._helpers, "batch-sim") if self._helpers else None
        self.collided = np.zeros(num_envs, bool)
        for data in self.datas:
            mujoco.mj_forward(self.model, data)
        self._publish()

    def reset(self, rows: np.ndarray, layouts: Sequence[Layout]) -> None:
        """Put `rows` (M,) int at rest at the start of their `layouts` (M of them), at time 0; the others go on.

        Nothing of the previous episode remains: controls, warm start and sensors are those of a fresh simulation.
        Raises ValueError for a row that is out of range or given twice, and for a layout that does not fit the scene;
        no row is changed then.
        """
        rows = np.atleast_1d(np.asarray(rows, dtype=int))
        if len(rows) != len(layouts) or len(set(rows.tolist())) != len(rows):
            raise ValueError(f"reset: {len(layouts)} layouts for rows {rows.tolist()}; one each, no row twice")
        if len(rows) and not (0 <= rows.min() and rows.max() < self.num_envs):
            raise ValueError(f"reset: rows {rows.tolist()} must lie in 0 to {self.num_envs - 1}")
        for layout in layouts:
            self._pool.check(layout)
        for row, layout in zip(rows.tolist(), layouts, strict=True):
            data = self.datas[row]
            mujoco.mj_resetData(self.model, data)
            self.robot.place(data.qpos, layout.start)
            self._pool.arrange(layout, data.mocap_pos, data.mocap_quat)
            mujoco.mj_forward(self.model, data)
            self._gremlins.pop(row, None)
            if len(layout.gremlins):
                self._gremlins[row] = layout
        self.collided = self.collided.copy()
        self.collided[rows] = False
        self._publish()

    def step(self, actions: np.ndarray) -> None:
        """One control step: `actions` (N, A), clipped to [-1, 1], are held for all substeps.

        Gremlins stand during the step where they are at its start. Raises ValueError for actions of another shape or
        that are not finite, naming the row; nothing is stepped then.
        """
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != (self.num_envs, self.model.nu):
            raise ValueError(f"step: actions have shape {actions.shape}, it must be {(self.num_envs, self.model.nu)}")
        if not np.isfinite(actions).all():
            row = int(np.flatnonzero(~np.isfinite(actions).all(axis=1))[0])
            raise ValueError(f"step: action of row {row} is not finite: {actions[row].tolist()}")
        self._controls = np.clip(actions, -1.0, 1.0)
        for row, layout in self._gremlins.items():
            data = self.datas[row]
            self._pool.move_gremlins(layout, data.time, data.mocap_pos)
        rows = iter(range(self.num_envs))  # of all threads: each takes the next row when it is done with one
        futures = [self._workers.submit(self._step_rows, rows) for _ in range(self._helpers)] if self._workers else []
        self._step_rows(rows)
        for future in futures:
            future.result()
        history = self._publish()
        total, floor, own = (history[:, columns] for columns in self._contact_columns)
        self.collided = (total > floor + own).any(axis=1) & self.finite

    def orientation(self) -> np.ndarray:
        """(N, 4) unit quaternions w, x, y, z from the body's frame to the world's, of the present state."""
        return self.robot.orientation(np.array([data.qpos for data in self.datas]))

    def close(self) -> None:
        """Stop the worker threads. The simulations cannot be stepped afterwards."""
        if self._workers is not None:
            self._workers.shutdown()

    def _sensor_values(self, name: str, size: int) -> slice:
        """Where the values of a sensor lie in `MjData.sensordata`; KeyError if the model has none of that name."""
        sensor = self.model.sensor(name)
        start, found = int(sensor.adr[0]), int(sensor.dim[0])
        if found != size:
            raise ValueError(
                f"sensor {name!r} of {self.robot.xml_path} has {found} value{'s' * (found != 1)}, {size} are observed"
            )
        return slice(start, start + size)

    def _step_rows(self, rows: Iterator[int]) -> None:
        model, substeps, controls, finite = self.model, self.robot.substeps, self._controls, self.finite
        for row in rows:
            if finite[row]:
                self._ctrl[row][:] = controls[row]
                mujoco.mj_step(model, self.datas[row], nstep=substeps)

    def _publish(self) -> np.ndarray:
        """Read all simulations into new arrays; returns the histories (N, H) of the sensors that have one."""
        robot = self.robot
        # one call for all rows: copying row by row takes longer than everything else in here
        qpos, qvel, readings, history = (np.concatenate(views).reshape(self.num_envs, -1) for views in self._views)
        self.time = np.array([data.time for data in self.datas])
        # a comparison with NaN is False
        self.finite = (np.abs(qpos).max(axis=1) < STATE_LIMIT) & (np.abs(qvel).max(axis=1) < STATE_LIMIT)
        if not self.finite.all():
            qpos[~self.finite] = qvel[~self.finite] = np.nan
        self.pose = robot.pose(qpos)
        self.velocity = robot.velocity(qvel)
        self.upright = robot.upright(qpos)
        self.sensors = {name: readings[:, columns] for name, columns in self._sensor_columns.items()}
        self.sensors |= self._joints.read(qpos, qvel)
        return history


def _history_values(model: mujoco.MjModel, sensor: str) -> slice:
    """Where the samples of a one-dimensional sensor lie in `MjData.history`: after two fields and their times."""
    index = model.sensor(sensor).id
    samples = int(model.sensor_history[index, 0])
    start = int(model.sensor_historyadr[index]) + 2 + samples
    return slice(start, start + samples)


def processors() -> int:
    """How many this process may use: more threads than that gain nothing."""
    # there is no such call on macOS
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
