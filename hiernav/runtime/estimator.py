"""Where the robot is and how fast it moves, from noisy, late and sometimes missing sensors."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from hiernav.runtime.doubts import Doubts
from hiernav.runtime.estimate import Estimate, EstimatorConfig, Trust
from hiernav.runtime.freshness import SensorWatch, TermWatch
from hiernav.runtime.planar_filter import BIAS, POSITION, VELOCITY, YAW, PlanarFilter, X, Y, wrap
from hiernav.runtime.position_history import PositionHistory
from hiernav.runtime.robot import ABSURD, VECTOR_SENSORS, SensorFrame
from hiernav.runtime.tilt import Quaternion, TiltFilter, Vector, dot, level_axes, rotation_between

MAX_RATE = 100.0
"""No robot turns faster than this [rad/s]."""
EARLY = 0.1
"""A fix measured up to this long after the inertial sensors of its frame is kept until they have caught up [s]."""
AT_REST = 0.05
"""Slower than this is not counted as travelling: it may be noise [m/s]."""
JUMP_AFTER, RESTART_AFTER = 2, 10
"""Frames in a row that must agree on another time before it is believed: a later one, and an earlier one."""


class _Accuracy(NamedTuple):
    """How exact a mean angular velocity is, and how far the accelerometer is trusted beside it."""

    walk: float
    """Error of the rate [rad/s]."""
    accelerometer_sigma: tuple[float, float]
    """As in `TiltFilter.correct`; where the turn is known, the accelerometer of a body that shakes is no help."""


_SAMPLED = _Accuracy(0.3, (0.3, 3.0))
_INTEGRATED = _Accuracy(0.05, (1.0, 10.0))


class Estimator:
    """Planar state estimator: predicts at the control rate, corrects with whatever passes its gate."""

    def __init__(self, config: EstimatorConfig | None = None) -> None:
        self.config = config = config or EstimatorConfig()
        self.counts: Counter[str] = Counter()
        """How often something was dropped, rejected or started again, by name."""
        self._field = math.hypot(*config.magnetic_field)
        self._field_heading = math.atan2(config.magnetic_field[1], config.magnetic_field[0])
        # Chi-square quantiles: of one normal variable's square, and of two such, which is an exponential distribution.
        self._gate_1 = NormalDist().inv_cdf(0.5 * (1.0 - config.gate_probability)) ** 2
        self._gate_2 = -2.0 * math.log(1.0 - config.gate_probability)
        self._limits = [(name, config.hold_after, config.lost_after) for name in VECTOR_SENSORS]
        self._limits.append(("position_fix", config.fix_hold_after, config.fix_lost_after))
        self._starts = 0
        self.skill_sensors: Mapping[str, int] | None = None
        """How many values each sensor gives that the skill observes; None: whatever comes is watched. From the next
        reset on."""
        self.driven = False
        """Whether the policies have driven the robot since the last frame: what is frozen is told only then."""
        self.reset()

    def reset(self) -> None:
        """Forget the state, as after being carried away. Counts are kept, and `Estimate.restarts` goes up."""
        config = self.config
        self._starts += 1
        # A body that shivers at rest, sampled in step with it, would otherwise pass for a gyro of any bias.
        self._filter = PlanarFilter(config.velocity_walk, config.bias_walk, 3.0 * config.bias_sigma)
        self._filter.replace(VELOCITY, (0.0, 0.0), 1.0)
        self._filter.replace((BIAS,), (0.0,), config.bias_sigma**2)
        self._tilt = TiltFilter(
            dip_sine=config.magnetic_field[2] / self._field,
            magnetometer_sigma=max(1.5 * config.magnetometer_sigma / self._field, 0.01),
        )
        self._stamp = self._odd_stamp = -math.inf
        self._odd = 0
        self._step = 0.0
        self._fix_stamp = self._fix_shown = -math.inf
        self._early: tuple[float, list[float]] | None = None
        self._rate: Vector = (0.0, 0.0, 0.0)
        self._yaw_rate = 0.0
        self._rotation: Quaternion | None = None
        self._has_position = self._has_yaw = False
        self._doubts = Doubts(config, self.counts)
        self._history = PositionHistory(config.history)
        # The accelerometer's noise is not the filter's business; its changes are told from noise all the same.
        sigmas = {name: getattr(config, f"{name}_sigma", 0.1) for name in VECTOR_SENSORS}
        self._watch = SensorWatch(sigmas | {"position_fix": config.fix_sigma})
        self._terms = TermWatch(self.skill_sensors)
        self._travelled = (0.0, 0.0)
        """Where it was driven to, by dead reckoning [m]."""
        self._flaws: dict[str, str] = {}

    @property
    def ready(self) -> bool:
        """Whether position and heading have been measured at least once."""
        return self._has_position and self._has_yaw

    @property
    def lacks(self) -> str:
        """Which sensors keep the first estimate waiting, and what is wrong with them; nothing once there is one."""
        waiting = (("position_fix", self._has_position), ("magnetometer", self._has_yaw))
        return ", ".join(f"{name}: {self._flaws.get(name, 'silent')}" for name, known in waiting if not known)

    def renew(self) -> None:
        """Somebody acknowledged a fault: lidar and robot's own terms are not held to repeat themselves any more."""
        self._terms.renew(self._stamp, self._travelled)

    def hears(self, sensor: str) -> bool:
        """Whether a sensor, such as "velocimeter", has ever said something, as far as is known."""
        return self._watch.knows(sensor)

    def silence(self, sensor: str) -> float:
        """For how long a sensor, such as "velocimeter", has said nothing usable [s]; 0 for one never heard of."""
        return self._watch.silence(sensor, self._stamp)

    def update(self, frame: SensorFrame) -> Estimate | None:
        """Take in one frame.

        A frame whose stamp is not after the last one, or far after it, is dropped as a whole, unless those that come
        next agree with it: then the robot's clock is another, and everything is measured anew. A fix whose stamp is not
        after the last fix is dropped alone. Values that are not finite or absurdly large count as missing.

        Returns:
            The state at the newest stamp; None until position and heading are known.
        """
        if self._accept_stamp(float(frame.stamp)):
            self._listen(frame)
            readings = {name: self._read(name, getattr(frame, name)) for name in VECTOR_SENSORS}
            field = self._trusted_field(readings["magnetometer"])
            turn = self._turn(frame.rotation)
            self._predict(readings["gyro"], turn, readings["accelerometer"], field)
            forward, left = level_axes(self._tilt.up)
            self._correct_yaw(field, forward, left)
            self._correct_velocity(readings["velocimeter"], forward, left)
            self._history.add(self._stamp, self._filter.x[X], self._filter.x[Y])
            self._take_fix(frame)
        return self._estimate() if self.ready else None

    def _listen(self, frame: SensorFrame) -> None:
        """Note which of the sensors that only the skill needs say something that it can use: lidar and robot's own."""
        if frame.lidar is not None:
            self._terms.see("lidar", frame.lidar, self._stamp, self._travelled)
        for name, value in frame.extra.items():
            self._terms.see(name, value, self._stamp, self._travelled)

    def _read(self, name: str, value: np.ndarray | None) -> Vector | None:
        """A sensor's reading, unless it is missing, garbage, or frozen for too long to be believed."""
        reading = _vector(value)
        if reading is None and value is not None:
            self._watch.expect(name, self._stamp)
            self._flaws[name] = _flaw(value, 3)
        self._watch.see(name, reading, self._stamp)
        if reading is None:
            return None
        self._flaws.pop(name, None)
        if self._watch.repetition(name, self._stamp) >= self.config.hold_after:
            self._flaws[name] = "repeats itself"
            self.counts[f"{name}_frozen"] += 1
            return None
        if name == "accelerometer":  # what it says is weighed, never rejected
            self._watch.believe(name, self._stamp)
        return reading

    def _accept_stamp(self, stamp: float) -> bool:
        """Move on to `stamp`; False if the frame is to be dropped."""
        first, step = math.isinf(self._stamp), stamp - self._stamp
        if not math.isfinite(stamp) or not (first or 0.0 < step <= self.config.max_gap):
            if not self._other_time(stamp):
                self.counts["stale_frame"] += 1
                return False
            self.counts["gap" if step > 0.0 else "clock_restart"] += 1
            watch, terms, first = self._watch, self._terms, True
            self.reset()
            self._watch, self._terms = watch, terms
            watch.begin_again(stamp)
            terms.begin_again(stamp)
        self._step = 0.0 if first else step
        self._stamp, self._odd = stamp, 0
        return True

    def _other_time(self, stamp: float) -> bool:
        """Whether a frame whose stamp does not follow is the newest of so many in a row that the clock must differ.

        Their stamps follow each other; a frame that comes again does not count.
        """
        step = stamp - self._odd_stamp
        if step == 0.0 or not math.isfinite(stamp):
            return False
        self._odd = self._odd + 1 if 0.0 < step <= self.config.max_gap else 1
        self._odd_stamp = stamp
        return self._odd >= (JUMP_AFTER if stamp > self._stamp else RESTART_AFTER)

    def _turn(self, rotation: np.ndarray | None) -> Vector | None:
        """How the body has turned since the last frame (rotation vector, body frame [rad]), if both say it."""
        before, self._rotation = self._rotation, _quaternion(rotation)
        # One that stays the same to the bit is of a unit that hangs, or of a body that does not turn anyway.
        if before is None or self._rotation is None or before == self._rotation:
            return None
        return rotation_between(before, self._rotation)

    def _predict(
        self, gyro: Vector | None, turn: Vector | None, accelerometer: Vector | None, field: Vector | None
    ) -> None:
        """Bring tilt, heading and position to the new stamp."""
        config = self.config
        dt, first = self._step, self._step == 0.0
        rate, change = self._measured_rate(gyro)
        if first:
            self._rate = rate
        mean, accuracy = _mean(self._rate, rate), _SAMPLED
        if turn is not None and gyro is not None and dt > 0.0:
            integrated = (turn[0] / dt, turn[1] / dt, turn[2] / dt)
            if math.dist(integrated, gyro) <= 2.0 * config.max_jump:
                mean, change, accuracy = integrated, 0.0, _INTEGRATED
                self._watch.believe("gyro", self._stamp)  # legs hammer: not every leap is a spike
            else:
                self.counts["rotation_rejected"] += 1
        if config.tilts:
            if dt > 0.0:
                self._tilt.predict(dt, mean, dt * math.hypot(accuracy.walk, 0.5 * change))
            self._tilt.correct(field, accelerometer, accuracy.accelerometer_sigma, self._gate_1)
        _, uy, uz = self._tilt.up
        # Of the body rates, what turns the heading: Euler's kinematic equation for yaw, in terms of `up`.
        level = max(uy * uy + uz * uz, 1e-2)
        self._yaw_rate = (rate[1] * uy + rate[2] * uz) / level
        if dt > 0.0:
            mean_yaw_rate = (mean[1] * uy + mean[2] * uz) / level
            variance = config.yaw_walk**2 * dt + (config.gyro_sigma * dt) ** 2 + (0.5 * change * dt) ** 2
            x, y, _, ahead, aside, _ = self._filter.x
            self._filter.predict_motion(dt, mean_yaw_rate, math.sqrt(variance))
            if self.driven and math.hypot(ahead, aside) > AT_REST:
                dx, dy = self._filter.x[X] - x, self._filter.x[Y] - y
                self._travelled = self._travelled[0] + dx, self._travelled[1] + dy
        self._rate = rate

    def _measured_rate(self, rate: Vector | None) -> tuple[Vector, float]:
        """The body rate and how much it may have changed within the tick [rad/s]; the last one if none was measured."""
        if rate is None:
            return self._rate, 1.0
        if max(map(abs, rate)) > MAX_RATE:
            self.counts["gyro_rejected"] += 1
            return self._rate, 1.0
        jump = math.dist(rate, self._rate)
        # One reading far off is a spike; three in a row are the truth.
        if jump > self.config.max_jump and not self._reject("gyro", rate, self.config.max_jump):
            return self._rate, 1.0
        self._accept("gyro", self._stamp)
        # What a jump adds to the angle is as uncertain as it is large.
        return rate, jump

    def _trusted_field(self, field: Vector | None) -> Vector | None:
        """The magnetometer's reading, if it is as strong as the world's field."""
        if field is None:
            return None
        excess = abs(math.sqrt(dot(field, field)) - self._field)
        if excess > 6.0 * self.config.magnetometer_sigma + 0.05 * self._field:
            self.counts["magnetometer_rejected"] += 1
            self._flaws["magnetometer"] = "not as strong as the world's field"
            return None
        return field

    def _correct_yaw(self, field: Vector | None, forward: Vector, left: Vector) -> None:
        if field is None:
            return
        ahead, aside = dot(field, forward), dot(field, left)
        level = math.hypot(ahead, aside)
        if level < 0.2 * self._field:
            return
        yaw = self._field_heading - math.atan2(aside, ahead)
        variance = (self.config.magnetometer_sigma / level) ** 2 + 1e-4
        miss = wrap(yaw - self._filter.yaw)
        if not self._has_yaw:
            self._has_yaw = True
            self._doubts.begin("magnetometer", field, self._stamp)
            self._filter.replace((YAW,), (wrap(yaw),), variance)
        elif self._filter.correct_yaw(miss, variance, self._gate_1):
            self._doubts.confirm("magnetometer", field, self._stamp, self.config.hold_after)
        elif "magnetometer" in self._doubts.unsure:
            self._filter.replace((YAW,), (wrap(yaw),), variance)
            if not self._doubts.agrees_roughly("magnetometer", field, (miss,), self._stamp):
                return
        elif self._reject("magnetometer", (miss,)):
            self._filter.replace((YAW,), (wrap(yaw),), variance)
        else:
            return
        self._accept("magnetometer", self._stamp)

    def _correct_velocity(self, velocity: Vector | None, forward: Vector, left: Vector) -> None:
        if velocity is None:
            return
        ahead, aside = dot(velocity, forward), dot(velocity, left)
        tilt_variance = self._tilt.sigma**2 * dot(velocity, velocity) if self.config.tilts else 0.0
        variance = self.config.velocimeter_sigma**2 + min(tilt_variance, 1.0)
        _, _, _, vx, vy, _ = self._filter.x
        miss = (ahead - vx, aside - vy)
        if not self._filter.correct_pair(VELOCITY, miss, variance, self._gate_2):
            if not self._reject("velocimeter", miss):
                return
            self._filter.replace(VELOCITY, (ahead, aside), variance)
        self._accept("velocimeter", self._stamp)

    def _take_fix(self, frame: SensorFrame) -> None:
        """Use the fix that this frame shows for the first time, and one that came before its time."""
        if self._early is not None and self._early[0] <= self._stamp + 1e-9:
            (stamp, fix), self._early = self._early, None
            self._correct_position(fix, stamp, shown_again=False)
        if frame.position_fix is None:
            return
        stamp = self._stamp if frame.fix_stamp is None else float(frame.fix_stamp)
        if stamp == self._fix_shown:  # an adapter shows each fix until there is a newer one
            return
        self._fix_shown = stamp
        components = _components(frame.position_fix, 2)
        if components is None:
            self.counts["fix_not_finite"] += 1
            self._flaws["position_fix"] = _flaw(frame.position_fix, 2)
            return
        self._flaws.pop("position_fix", None)
        if self._early is None and self._stamp + 1e-9 < stamp <= self._stamp + EARLY:
            self._early = stamp, components
        else:
            self._correct_position(components, stamp, shown_again=frame.fix_stamp is None)

    def _correct_position(self, fix: list[float], stamp: float, shown_again: bool) -> None:
        """Take in a fix measured at `stamp` [s]; `shown_again`: it may be the last one, under its frame's stamp."""
        if not stamp > self._fix_stamp or stamp > self._stamp + 1e-9 or not self._history.reaches(stamp):
            self.counts["stale_fix"] += 1
            return
        self._fix_stamp = stamp
        self._watch.see("position_fix", tuple(fix), stamp)
        if self._watch.repetition("position_fix", stamp) >= self.config.hold_after:
            self.counts["position_fix_frozen"] += 1
            self._flaws["position_fix"] = "repeats itself"
            return
        then = self._history.at(stamp)
        miss = (fix[0] - then[0], fix[1] - then[1])
        variance = self.config.fix_sigma**2
        x, y = self._filter.x[:2]
        first, self._has_position = not self._has_position, True
        if not first and self._filter.correct_pair(POSITION, miss, variance, self._gate_2):
            self._history.shift(stamp, self._filter.x[X] - x, self._filter.x[Y] - y)
            patience = self.config.fix_hold_after if shown_again else 0.0
            self._doubts.confirm("position_fix", fix, self._stamp, patience)
        else:
            unsure = "position_fix" in self._doubts.unsure
            if not (first or unsure or self._reject("position_fix", miss)):
                return
            self._filter.replace(POSITION, (x + miss[0], y + miss[1]), variance)
            self._history.shift(-math.inf, *miss)
            if first:
                self._doubts.begin("position_fix", fix, self._stamp)
            elif unsure and not self._doubts.agrees_roughly("position_fix", fix, miss, self._stamp):
                return
        self._accept("position_fix", stamp)

    def _accept(self, sensor: str, stamp: float) -> None:
        """A measurement taken at `stamp` [s] was used."""
        self._doubts.accept(sensor)
        self._watch.believe(sensor, stamp)

    def _reject(self, sensor: str, miss: tuple[float, ...], spread: float | None = None) -> bool:
        """Count a rejected measurement; True if it is to be believed after all, as `Doubts.reject` says."""
        if not self._doubts.reject(sensor, miss, self._stamp, spread or self.config.reinit_spread):
            return False
        moved = math.hypot(*miss) > self.config.reinit_spread
        self._starts += moved and sensor in ("position_fix", "magnetometer")
        return True

    def _trust(self) -> tuple[Trust, str]:
        """What the estimate is good for, judged by the sensor that has been silent for too long."""
        worst, why = Trust.GOOD, ""
        for name in self._doubts.unsure:  # a first reading may be a spike
            worst, why = Trust.HOLD, f"{name}: no second reading that agrees with the first yet"
        for name, hold, lost in self._limits:
            silence = self._watch.silence(name, self._stamp)
            if silence < hold:
                continue
            trust = (
                Trust.LOST
                if silence >= lost and not self._doubts.may_yet_be_believed(name, self._stamp)
                else Trust.HOLD
            )
            if trust > worst:
                flaw = self._flaws.get(name)
                worst, why = trust, f"{name} says nothing usable for {silence:.2f} s{f' ({flaw})' if flaw else ''}"
        for name, silence, flaw in self._terms.silences(self._stamp):
            if silence < self.config.hold_after:
                continue
            trust = Trust.LOST if silence >= self.config.lost_after else Trust.HOLD
            if trust > worst:
                worst, why = trust, f"{name} says nothing usable for {silence:.2f} s{f' ({flaw})' if flaw else ''}"
        return worst, why

    def _estimate(self) -> Estimate:
        x, y, yaw, ahead, aside, bias = self._filter.x
        cos, sin = math.cos(yaw), math.sin(yaw)
        trust, why = self._trust()
        return Estimate(
            stamp=self._stamp,
            pose=np.array([x, y, yaw]),
            velocity=np.array([cos * ahead - sin * aside, sin * ahead + cos * aside]),
            covariance=np.array(self._filter.P),
            upright=self._tilt.up[2],
            yaw_rate=self._yaw_rate - bias,
            trust=trust,
            why=why,
            restarts=self._starts - 1,
        )


def _quaternion(value: np.ndarray | None) -> Quaternion | None:
    parts = _components(value, 4)
    if parts is None or not abs(math.fsum(part * part for part in parts) - 1.0) < 1e-3:
        return None
    return parts[0], parts[1], parts[2], parts[3]


def _vector(value: np.ndarray | None) -> Vector | None:
    components = _components(value, 3)
    return None if components is None else (components[0], components[1], components[2])


def _components(value: np.ndarray | None, size: int) -> list[float] | None:
    """The components of a measurement as floats; None if it is missing, misshapen, not finite or absurd."""
    if value is None:
        return None
    values = np.asarray(value, dtype=np.float64).ravel().tolist()
    if len(values) != size:
        return None
    for component in values:
        if not -ABSURD < component < ABSURD:
            return None
    return values


def _flaw(value: np.ndarray, size: int) -> str:
    """What is wrong with a measurement that `_components` refuses."""
    count = np.size(value)
    return f"{count} values instead of {size}" if count != size else "not finite, or absurd"


def _mean(a: Vector, b: Vector) -> Vector:
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])
