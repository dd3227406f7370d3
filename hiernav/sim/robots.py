"""The robots that can be simulated, and how their state is read and set.

A robot is an MJCF file in `models/` plus a `RobotSpec`. Everything below works on batches of generalised
coordinates, `qpos (N, nq)` and `qvel (N, nv)`, so that one call reads all simulations. Their quaternions have unit
length, as MuJoCo keeps them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hiernav.nav.frames import wrap_angle
from hiernav.nav.observation import ObservationLayout, ObservationTerm, observation_layout

if TYPE_CHECKING:  # who only asks what a robot is like, such as a control loop, needs no physics
    import mujoco

MODEL_DIR = Path(__file__).parent / "models"
BASE_SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer")


@dataclass(frozen=True)
class RobotSpec:
    """What the simulation and the planner need to know about a robot.

    `radius` is the planning radius: the disc around the body origin that plans keep clear of obstacles. It is the
    body of the point robot, and the car to within 2 cm in any heading. The doggo's feet reach further, but a disc
    around them would close gaps that it can walk through.
    """

    name: str
    action_dim: int
    timestep: float
    """Physics step [s]."""
    radius: float
    """Planning radius [m]."""
    start_height: float
    """Height of the body origin at the start of an episode [m]."""
    free_base: bool = True
    """True: the base is a free joint. False: it is two slides and a yaw hinge."""
    observed_hinges: tuple[str, ...] = ()
    """Hinges whose sine, cosine and velocity are observed, in this order."""
    observed_ball: str | None = None
    """Ball joint whose rotation and angular velocity are observed."""
    substeps: int = 10
    """Physics steps per control step."""
    observed_sensors: tuple[ObservationTerm, ...] = ()
    """Sensors of the model, by name, that are observed besides those of every robot, such as a range finder."""

    @property
    def xml_path(self) -> Path:
        """The MJCF file of the robot alone: no floor, no obstacles."""
        return MODEL_DIR / f"{self.name}.xml"

    @property
    def control_period(self) -> float:
        """Time between two actions [s]."""
        return self.timestep * self.substeps

    @property
    def own_terms(self) -> tuple[ObservationTerm, ...]:
        """The observation terms that only this robot has."""
        terms: tuple[ObservationTerm, ...] = ()
        if self.observed_ball is not None:
            terms += (
                ObservationTerm(f"{self.observed_ball}_rotation", 9, "rotation matrix", 1.0),
                ObservationTerm(f"{self.observed_ball}_velocity", 3, "rad/s", 0.1),
            )
        if self.observed_hinges:
            count = len(self.observed_hinges)
            terms += (
                ObservationTerm("joint_sin", count, "", 1.0),
                ObservationTerm("joint_cos", count, "", 1.0),
                ObservationTerm("joint_velocity", count, "rad/s", 0.1),
            )
        return terms + self.observed_sensors

    def observation_layout(self, guidance: str = "waypoints", clock: bool = False) -> ObservationLayout:
        """What the skill of this robot observes; see `hiernav.nav.observation.observation_layout`."""
        return observation_layout(self.own_terms, guidance, clock)

    def place(self, qpos: np.ndarray, pose: np.ndarray) -> None:
        """Write the start at `pose` (3,) = x, y, yaw into `qpos` (nq,) in place; the other joints are left alone."""
        x, y, yaw = pose
        if self.free_base:
            qpos[:7] = x, y, self.start_height, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        else:
            qpos[:3] = x, y, yaw

    def pose(self, qpos: np.ndarray) -> np.ndarray:
        """(N, nq) -> (N, 3) x, y [m] and yaw [rad] in [-pi, pi), the direction of the body's x axis seen from above."""
        if not self.free_base:
            return np.column_stack([qpos[:, :2], wrap_angle(qpos[:, 2])])
        w, x, y, z = qpos[:, 3:7].T
        pose = np.empty((len(qpos), 3))
        pose[:, :2] = qpos[:, :2]
        pose[:, 2] = wrap_angle(np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z)))
        return pose

    def orientation(self, qpos: np.ndarray) -> np.ndarray:
        """(N, nq) -> (N, 4) unit quaternions w, x, y, z from the body's frame to the world's."""
        if self.free_base:
            return qpos[:, 3:7].copy()
        half, zero = 0.5 * qpos[:, 2], np.zeros(len(qpos))
        return np.column_stack([np.cos(half), zero, zero, np.sin(half)])

    def upright(self, qpos: np.ndarray) -> np.ndarray:
        """(N, nq) -> (N,) z component of the body's z axis: 1 upright, -1 on its back."""
        if not self.free_base:
            return np.ones(len(qpos))
        return 1.0 - 2.0 * np.square(qpos[:, 4:6]).sum(axis=1)

    def velocity(self, qvel: np.ndarray) -> np.ndarray:
        """(N, nv) -> (N, 2) velocity of the body origin in the world frame [m/s]."""
        return qvel[:, :2].copy()


class JointReader:
    """Reads a robot's own observation terms from batches of its generalised coordinates."""

    def __init__(self, robot: RobotSpec, model: mujoco.MjModel) -> None:
        """Look the observed joints up in `model`; KeyError if it lacks one of them."""
        self._robot = robot
        self._hinge_qpos = np.array([model.joint(name).qposadr[0] for name in robot.observed_hinges], int)
        self._hinge_qvel = np.array([model.joint(name).dofadr[0] for name in robot.observed_hinges], int)
        if robot.observed_ball is not None:
            ball = model.joint(robot.observed_ball)
            self._ball_qpos = slice(ball.qposadr[0], ball.qposadr[0] + 4)
            self._ball_qvel = slice(ball.dofadr[0], ball.dofadr[0] + 3)

    def read(self, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, np.ndarray]:
        """(N, nq), (N, nv) -> those of `RobotSpec.own_terms` that joints give, each (N, size) and a new array.

        Rotations are matrices in row-major order, from the joint's frame to its parent's; rates are in rad/s.
        """
        terms: dict[str, np.ndarray] = {}
        name = self._robot.observed_ball
        if name is not None:
            terms[f"{name}_rotation"] = rotation_matrices(qpos[:, self._ball_qpos])
            terms[f"{name}_velocity"] = qvel[:, self._ball_qvel].copy()
        if self._robot.observed_hinges:
            angles = qpos[:, self._hinge_qpos]
            terms["joint_sin"] = np.sin(angles)
            terms["joint_cos"] = np.cos(angles)
            terms["joint_velocity"] = qvel[:, self._hinge_qvel]
        return terms


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions w, x, y, z -> (N, 9) rotation matrices in row-major order.

    Entry by entry 2 (q[a] q[b] + sign q[c] q[d]), less 1 on the diagonal: few operations over long rows.
    """
    a, b, c, d, sign = _ROTATION_TERMS
    q = quaternions
    return 2.0 * (q[:, a] * q[:, b] + sign * (q[:, c] * q[:, d])) - _IDENTITY


_IDENTITY = np.eye(3).reshape(9)
_ROTATION_TERMS = np.array(
    [
        (0, 0, 1, 1, 1),
        (1, 2, 0, 3, -1),
        (1, 3, 0, 2, 1),
        (1, 2, 0, 3, 1),
        (0, 0, 2, 2, 1),
        (2, 3, 0, 1, -1),
        (1, 3, 0, 2, -1),
        (2, 3, 0, 1, 1),
        (0, 0, 3, 3, 1),
    ]
).T

_LEGS = (1, 2, 3, 4)
_DOGGO_HINGES = (
    *(f"hip_{leg}_z" for leg in _LEGS),
    *(f"hip_{leg}_y" for leg in _LEGS),
    *(f"ankle_{leg}" for leg in _LEGS),
)

ROBOTS: dict[str, RobotSpec] = {
    spec.name: spec
    for spec in (
        RobotSpec("point", action_dim=2, timestep=0.002, radius=0.1, start_height=0.1, free_base=False),
        RobotSpec("car", action_dim=2, timestep=0.004, radius=0.2, start_height=0.1, observed_ball="rear"),
        RobotSpec("doggo", action_dim=12, timestep=0.01, radius=0.2, start_height=0.22, observed_hinges=_DOGGO_HINGES),
    )
}


def get_robot(name: str) -> RobotSpec:
    """The robot of that name; ValueError naming the accepted names otherwise."""
    try:
        return ROBOTS[name]
    except KeyError:
        raise ValueError(f"unknown robot {name!r}; accepted: {', '.join(ROBOTS)}") from None
