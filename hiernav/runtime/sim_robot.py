"""A simulated robot behind the interface of a real one: noisy sensors, late fixes, and a watchdog of its own."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from hiernav.nav.lidar import lidar_closeness
from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime.clock import Clock, MonotonicClock
from hiernav.runtime.noise import SensorNoise
from hiernav.runtime.robot import VECTOR_SENSORS, CommandWatchdog, SensorFrame, Truth
from hiernav.sim.batch import BatchSim
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.robots import RobotSpec, get_robot
from hiernav.sim.scene import scene_for
from hiernav.sim.worlds import sample_layout


def make(
    robot: str, world: str, seed: int = 0, noise: dict[str, Any] | None = None, substeps: int | None = None
) -> SimRobot:
    """A simulated robot in real time, for `ProcessRobot`.

    Args:
        robot: "point", "car" or "doggo".
        world: kind of world, as on the command line.
        seed: of the world and of the noise; `SimRobot.restart` takes another one.
        noise: fields of `SensorNoise` that differ from their defaults.
        substeps: physics steps per command, where it is not to be driven at the rate it was trained at.
    """
    spec = get_robot(robot)
    if substeps is not None:
        spec = replace(spec, substeps=substeps)
    layout = sample_layout(parse_world(world), seed, spec.radius)
    return SimRobot(spec, layout, SensorNoise(**(noise or {})), seed, MonotonicClock())


class SimRobot:
    """One simulated robot in one layout. Each command lets one control period pass.

    Given a clock, it lives in that clock's time: periods in which no command came pass as well, under the last
    command until that is too old, then braked.
    """

    def __init__(
        self,
        robot: RobotSpec,
        layout: Layout,
        noise: SensorNoise | None = None,
        seed: int = 0,
        clock: Clock | None = None,
    ) -> None:
        """
        Args:
            robot: what to simulate.
            layout: where; also start pose and obstacles. `reset` takes others of the same kind of world.
            noise: of the sensors.
            seed: of the noise.
            clock: time to live in; None lets time pass with commands only.
        """
        self.spec = robot
        self.noise = noise or SensorNoise()
        self.watchdog = CommandWatchdog(robot.control_period)
        self._clock = clock
        self._sim = BatchSim(robot, 1, scene_for([layout.spec]))
        self.reset(layout, seed)

    @property
    def control_period(self) -> float:
        return self.spec.control_period

    @property
    def action_dim(self) -> int:
        return self.spec.action_dim

    def reset(self, layout: Layout, seed: int = 0) -> None:
        """Start anew in `layout`, with the noise of `seed`."""
        self.layout = layout
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, 0x5E4503]))
        self._sim.reset(np.array([0]), [layout])
        self._collisions = 0
        self._held = np.zeros(self.action_dim)
        self._advanced_at: float | None = None
        self._pending: deque[tuple[float, float, np.ndarray]] = deque()
        self._next_fix = 0.0
        self._frame: SensorFrame | None = None
        self._drift = np.random.default_rng(np.random.SeedSequence([seed, 0x7042]))
        self._before, self._sensed = self._sim.orientation()[0], np.array([1.0, 0.0, 0.0, 0.0])

    def restart(self, seed: int) -> None:
        """Start anew in another world of the same kind, with the noise of `seed`."""
        self.reset(sample_layout(self.layout.spec, seed, self.spec.radius), seed)

    def read(self) -> SensorFrame:
        self._catch_up()
        if self._frame is None:
            self._frame = self._sense()
        return self._frame

    def send(self, action: np.ndarray) -> np.ndarray:
        """Apply `action` (A,), clipped to [-1, 1], for one control period.

        Raises:
            ValueError: wrong shape, or not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self.action_dim,):
            raise ValueError(f"SimRobot.send: action has shape {action.shape}, expected ({self.action_dim},)")
        if not np.isfinite(action).all():
            raise ValueError(f"SimRobot.send: action {action.tolist()} is not finite")
        sent = np.clip(action, -1.0, 1.0)
        if self._clock is not None:
            self._advanced_at = self._clock.now()
            self.watchdog.feed(self._advanced_at)
        self._step(sent)
        return sent

    def brake(self) -> None:
        """All actuators off for one control period."""
        self.send(np.zeros(self.action_dim))

    def close(self) -> None:
        self._sim.close()

    def truth(self) -> Truth:
        sim = self._sim
        return Truth(
            time=float(sim.time[0]),
            pose=sim.pose[0],
            velocity=sim.velocity[0],
            upright=float(sim.upright[0]),
            collided=bool(sim.collided[0]),
            collisions=self._collisions,
        )

    def occupancy(self, stamp: float) -> OccupancyMap:
        """The known map, with moving obstacles where they are at `stamp` [s]."""
        return self.layout.occupancy(stamp)

    def _step(self, action: np.ndarray) -> None:
        self._held = action
        self._sim.step(action[None])
        self._integrate()
        self._collisions += int(self._sim.collided[0])
        self._frame = None

    def _catch_up(self) -> None:
        """Let the periods pass in which no command came."""
        if self._clock is None or self._advanced_at is None:
            return
        now, period = self._clock.now(), self.control_period
        # Half a period of tolerance: a command that is merely late is not a missed one.
        for _ in range(int((now - self._advanced_at) / period - 0.5)):
            self._advanced_at += period
            self._step(np.zeros(self.action_dim) if self.watchdog.expired(self._advanced_at) else self._held)

    def _sense(self) -> SensorFrame:
        sim, noise = self._sim, self.noise
        now = float(sim.time[0])
        readings: dict[str, np.ndarray | None] = {}
        for name in VECTOR_SENSORS:
            value = sim.sensors[name][0] + getattr(noise, name) * self._rng.standard_normal(3)
            lost = self._rng.random() < noise.dropout
            readings[name] = None if lost else value
        if readings["gyro"] is not None:
            readings["gyro"] = readings["gyro"] + noise.gyro_bias
        extra = {
            term.name: sim.sensors[term.name][0] + noise.extra * self._rng.standard_normal(term.size)
            for term in self.spec.own_terms
        }
        fix, fix_stamp = self._sense_position(now)
        return SensorFrame(
            stamp=now,
            **readings,
            lidar=self._sense_lidar(now),
            extra=extra,
            position_fix=fix,
            fix_stamp=fix_stamp,
            rotation=self._sensed,
        )

    def _integrate(self) -> None:
        """Have the inertial unit turn as the body has in the last step, but for its gyro's bias and noise."""
        after, noise, count = self._sim.orientation()[0], self.noise, self.spec.substeps
        if not np.isfinite(after).all():
            return
        turn = np.zeros(3)
        mujoco.mju_subQuat(turn, after, self._before)
        # of as many samples as there are physics steps
        turn += self.control_period * (noise.gyro_bias + noise.gyro / np.sqrt(count) * self._drift.standard_normal(3))
        self._before, self._sensed = after, self._sensed.copy()
        mujoco.mju_quatIntegrate(self._sensed, turn, 1.0)

    def _sense_lidar(self, now: float) -> np.ndarray:
        closeness = lidar_closeness(self._sim.pose, self.layout.obstacle_discs(now)[None])[0]
        if self.noise.lidar > 0.0:
            error = self.noise.lidar * self._rng.standard_normal(len(closeness))
            closeness = np.minimum(closeness * np.exp(-error), 1.0)  # closeness is exp(-distance)
        return closeness

    def _sense_position(self, now: float) -> tuple[np.ndarray | None, float | None]:
        noise = self.noise
        if now >= self._next_fix - 1e-9:
            missed = math.floor((now - self._next_fix) / noise.fix_period + 1e-6)
            self._next_fix += (missed + 1) * noise.fix_period
            measured = self._sim.pose[0, :2] + noise.fix * self._rng.standard_normal(2)
            if self._rng.random() >= noise.fix_dropout:
                self._pending.append((now + noise.fix_latency, now, measured))
        if self._pending and self._pending[0][0] <= now + 1e-9:
            _, stamp, fix = self._pending.popleft()
            return fix, stamp
        return None, None
