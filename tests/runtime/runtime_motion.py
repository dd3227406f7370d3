"""Recorded motions of the three robots, and noisy frames made from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hiernav.runtime.estimate import Estimate, EstimatorConfig
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.planar_filter import wrap
from hiernav.runtime.robot import VECTOR_SENSORS, SensorFrame

REFERENCE = Path(__file__).parents[1] / "data" / "reference"
SIGMA = {"accelerometer": 0.1, "gyro": 0.02, "magnetometer": 0.01, "velocimeter": 0.02}
FIX_SIGMA = 0.02
FIX_PERIOD = 0.1


@dataclass(frozen=True)
class Motion:
    """What a robot did: stamps (T,), poses (T, 3), upright (T,) and clean sensors (T, 3)."""

    name: str
    stamps: np.ndarray
    poses: np.ndarray
    upright: np.ndarray
    sensors: dict[str, np.ndarray]


def recorded(name: str) -> Motion:
    """200 control steps of "point", "car" or "doggo" under fixed controls."""
    data = np.load(REFERENCE / f"{name}_rollout.npz", allow_pickle=False)
    matrix, position = data["robot_mat"], data["robot_pos"]
    yaw = np.arctan2(matrix[:, 1, 0], matrix[:, 0, 0])
    return Motion(
        name=name,
        stamps=np.arange(len(position)) * float(data["timestep"]) * int(data["substeps"]),
        poses=np.column_stack([position[:, :2], yaw]),
        upright=matrix[:, 2, 2],
        sensors={sensor: data[f"sensor_{sensor}"] for sensor in VECTOR_SENSORS},
    )


def frames(motion: Motion, seed: int = 0, latency: float = 0.0, noise: float = 1.0) -> Iterator[SensorFrame]:
    """One frame per stamp; a position fix every 0.1 s, delivered `latency` seconds after it was measured."""
    rng = np.random.default_rng(seed)
    pending: list[tuple[float, float, np.ndarray]] = []
    every = max(1, round(FIX_PERIOD / (motion.stamps[1] - motion.stamps[0])))
    for k, stamp in enumerate(motion.stamps):
        values = {
            name: motion.sensors[name][k] + noise * sigma * rng.standard_normal(3) for name, sigma in SIGMA.items()
        }
        if k % every == 0:
            delay = latency if k else 0.0
            pending.append((stamp + delay, stamp, motion.poses[k, :2] + noise * FIX_SIGMA * rng.standard_normal(2)))
        fix = fix_stamp = None
        if pending and pending[0][0] <= stamp + 1e-9:
            _, fix_stamp, fix = pending.pop(0)
        yield SensorFrame(float(stamp), **values, position_fix=fix, fix_stamp=fix_stamp)


def estimator_for(motion: Motion, **changes: object) -> Estimator:
    estimator = Estimator(replace(EstimatorConfig(tilts=motion.name != "point"), **changes))
    estimator.driven = True
    return estimator


@dataclass(frozen=True)
class Errors:
    """What an estimator got wrong, from its first confirmed estimate on: position (T,) [m] and yaw (T,) [rad]."""

    position: np.ndarray
    yaw: np.ndarray
    estimates: list[Estimate]

    @property
    def position_rms(self) -> float:
        return float(np.sqrt(np.mean(self.position**2)))

    @property
    def yaw_rms(self) -> float:
        return float(np.sqrt(np.mean(self.yaw**2)))


def follow(
    motion: Motion,
    estimator: Estimator,
    stream: Iterator[SensorFrame],
    damage: Callable[[SensorFrame], SensorFrame] = lambda frame: frame,
    confirmed: bool = True,
) -> Errors:
    """Feed every frame, after `damage`, and compare with the truth at its stamp.

    Estimates that rest on a first reading alone are left out, unless `confirmed` is False.
    """
    position, yaw, estimates = [], [], []
    for k, frame in enumerate(stream):
        estimate = estimator.update(damage(frame))
        if estimate is not None and (estimates or not confirmed or "no second reading" not in estimate.why):
            position.append(float(np.linalg.norm(estimate.pose[:2] - motion.poses[k, :2])))
            yaw.append(wrap(float(estimate.pose[2] - motion.poses[k, 2])))
            estimates.append(estimate)
    return Errors(np.array(position), np.array(yaw), estimates)
