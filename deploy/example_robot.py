"""A new robot in one file: copy it, and put your hardware's calls where `Board` stands.

    python deploy/run_loop.py --adapter deploy/example_robot.py:make --world "pillar(2,2,0)" --goal 1.2,0.8

The board here is a stand-in that computes what a small two-wheeled base would do, so that the file runs as it is. The
policies are those of the point robot: action 0 drives forward, action 1 turns counter-clockwise, both in [-1, 1].
The table of bodies in README.md says how fast.

While this code blocks, or if its process is killed, nothing in hiernav can brake the robot. The motor controller must
stop by itself when commands stop coming, as `Board` does.
"""

from __future__ import annotations

import math
import time

import numpy as np

from hiernav.runtime.robot import SensorFrame

SATURATION = 0.05
"""Command of the drive that is full force on the point robot, beyond which it gets no faster."""


class ExampleRobot:
    """What the runtime asks of a robot. `read`, `send` and `brake` must return within a fraction of a period."""

    control_period = 0.02
    """[s]; must be that of the bundle."""
    action_dim = 2

    def __init__(self, board: Board) -> None:
        self._board = board
        self._next_fix = 0.0

    def read(self) -> SensorFrame:
        """The newest values: always a frame. A field that its sensor does not give in time is None: never wait, and
        never repeat the last value.

        Called several times in a control period; the adapter gathers what came since the loop looked last, so that each
        sensor may have a rate of its own. All in SI units and in the body frame (x forward, y left, z up); the stamp is
        a monotonic clock's.
        """
        board = self._board
        now = board.update()
        position = None
        if now >= self._next_fix:  # a position from outside comes at a rate of its own
            self._next_fix = now + 0.1
            position = board.position()
        return SensorFrame(
            stamp=now,
            accelerometer=np.array([0.0, 0.0, 9.81]),
            gyro=board.turning_rate(),
            magnetometer=board.field(),
            velocimeter=board.wheel_speed(),
            lidar=np.zeros(10),  # closeness in ten sectors, see hiernav/nav/lidar.py; nothing near
            position_fix=position,
            fix_stamp=None if position is None else now,
        )

    def send(self, action: np.ndarray) -> np.ndarray:
        """Command the actuators, as the body does for which the skill was trained; returns what was commanded."""
        drive = float(np.clip(action[0], -SATURATION, SATURATION))
        turn = float(np.clip(action[1], -1.0, 1.0))
        self._board.command(drive=drive / SATURATION, turn=turn)
        return np.array([drive, turn])  # ignored behind an adapter's process

    def brake(self) -> None:
        """The safe stop. Called at every tick in which the robot must not move, and by the adapter's own watchdog."""
        self._board.command(drive=0.0, turn=0.0)

    def close(self) -> None:
        self._board.command(drive=0.0, turn=0.0)


class Board:
    """Stand-in for a motor controller with encoders, a gyro, a compass and a beacon.

    It stops by itself when no command came for `timeout` seconds. A real one must too, in its own firmware.
    """

    timeout = 0.1
    """[s]"""

    def __init__(self, x: float, y: float, yaw: float) -> None:
        self._x, self._y, self._yaw = x, y, yaw
        self._speed = self._turn = 0.0
        self._drive, self._turning = 0.0, 0.0
        self._rng = np.random.default_rng(0)
        self._at = self._commanded_at = time.monotonic()

    def update(self) -> float:
        """Let time pass until now; the time [s]."""
        now = time.monotonic()
        while now - self._at > 1e-9:
            dt = min(now - self._at, 0.002)
            if self._at - self._commanded_at > self.timeout:
                self._drive = self._turning = 0.0
            self._speed += (3.0 * self._drive - 2.0 * self._speed) * dt  # 1.5 m/s at most
            self._turn += (3.0 * self._turning - self._turn) * dt / 0.05  # 3 rad/s at most
            self._yaw += self._turn * dt
            self._x += self._speed * math.cos(self._yaw) * dt
            self._y += self._speed * math.sin(self._yaw) * dt
            self._at += dt
        return now

    def command(self, drive: float, turn: float) -> None:
        """Drive and turn with these shares of full force and of the top turning rate, until the next command."""
        self._commanded_at = self.update()
        self._drive, self._turning = drive, turn

    def position(self) -> np.ndarray:
        return np.array([self._x, self._y]) + self._rng.normal(0.0, 0.02, 2)

    def wheel_speed(self) -> np.ndarray:
        return np.array([self._speed, 0.0, 0.0]) + self._rng.normal(0.0, 0.02, 3)

    def turning_rate(self) -> np.ndarray:
        return np.array([0.0, 0.0, self._turn]) + self._rng.normal(0.0, 0.02, 3)

    def field(self) -> np.ndarray:
        """The field points along the world's -y, as the bundles assume."""
        field = 0.5 * np.array([-math.sin(self._yaw), -math.cos(self._yaw), 0.0])
        return field + self._rng.normal(0.0, 0.01, 3)


def make(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> ExampleRobot:
    """Called once, in the adapter's process."""
    return ExampleRobot(Board(x, y, yaw))
