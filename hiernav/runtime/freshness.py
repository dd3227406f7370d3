"""Which sensors still say something new and credible, and which have gone silent, repeat themselves or only lie."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hiernav.runtime.terms import is_sound

Reading = tuple[float, ...]

STIR, LEAP = 0.5, 8.0
"""Changes of a reading, in standard deviations: noise causes the first within moments, only motion the second."""
LEARN = 10
"""Readings without repetition after which a sensor is known to be noisy."""
REPEATS = 3
"""Repetitions in a row, while nothing else changes either, that a noisy sensor never shows."""
TRAVEL, SPARE = 0.2, 3.0
"""How far a robot is driven before lidar and joints must read something else [m], and, where they are coarse, how many
times as far as any reading has lasted. The first is farther than dead reckoning runs on while a robot hits a wall."""


@dataclass
class _Sensor:
    sigma: float
    value: Reading
    """The last one; nothing if it never gave any."""
    believed: float
    new: float
    changes: int = 0
    repeats: int = 0
    repeats_itself: bool = False
    stir_from: Reading = ()
    stirred: float = -math.inf
    leap_from: Reading = ()
    leapt: float = -math.inf


class SensorWatch:
    """Remembers when each sensor last said something new that was believed.

    Noise makes a sensor differ from one reading to the next. One that has done so, then repeats itself to the bit
    under fresh stamps while others go on changing, is frozen; so are all of them if all repeat themselves at once, and
    none ever did before. A reading of nothing but zeros is what wheel encoders say at rest; it is frozen only once
    another sensor has changed as only motion changes it. A sensor that repeats itself in health, being coarse or
    without noise, is not judged: what it says wrong is for the gates to find.
    """

    def __init__(self, sigma: Mapping[str, float]) -> None:
        """
        Args:
            sigma: standard deviation of each sensor's noise, in its own unit.
        """
        self._sigma = dict(sigma)
        self._sensors: dict[str, _Sensor] = {}
        self._thawed = -math.inf
        """When sensors that had all repeated themselves began to change again [s]."""

    def begin_again(self, stamp: float) -> None:
        """The robot's clock is another one from `stamp` [s] on: forget all readings, not which sensors repeat them."""
        for name, sensor in self._sensors.items():
            self._sensors[name] = _Sensor(sensor.sigma, (), stamp, stamp, repeats_itself=sensor.repeats_itself)
        self._thawed = -math.inf

    def expect(self, name: str, stamp: float) -> None:
        """The robot has this sensor, whatever it says: it counts as silent from `stamp` [s] on until it is heard of."""
        if name not in self._sensors:
            self._sensors[name] = _Sensor(self._sigma[name], (), stamp, stamp)

    def knows(self, name: str) -> bool:
        """Whether the robot has this sensor, as far as is known."""
        return name in self._sensors

    def see(self, name: str, value: Reading | None, stamp: float) -> None:
        """Take note of a reading, None where there was none, at `stamp` [s]."""
        if value is None:
            return
        sensor = self._sensors.get(name)
        if sensor is None or not sensor.value:
            since = stamp if sensor is None else sensor.believed
            new = _Sensor(self._sigma[name], value, since, stamp, stir_from=value, leap_from=value)
            new.repeats_itself = sensor is not None and sensor.repeats_itself
            self._sensors[name] = new
            return
        if value == sensor.value:
            sensor.repeats += 1
            return
        if sensor.repeats >= REPEATS and not self._hung(name, sensor, stamp):
            sensor.repeats_itself = True
        sensor.changes += 1
        sensor.repeats = 0
        sensor.value, sensor.new = value, stamp
        if math.dist(value, sensor.stir_from) > STIR * sensor.sigma:
            sensor.stir_from, sensor.stirred = value, stamp
        if math.dist(value, sensor.leap_from) > LEAP * sensor.sigma:
            sensor.leap_from, sensor.leapt = value, stamp

    def believe(self, name: str, stamp: float) -> None:
        """The reading that was seen last was used, at `stamp` [s]: what is only ever rejected is as good as silence."""
        self._sensors[name].believed = stamp

    def silence(self, name: str, stamp: float) -> float:
        """For how long a sensor has said nothing new that was believed [s]; 0 for one that the robot may not have."""
        sensor = self._sensors.get(name)
        if sensor is None:
            return 0.0
        return stamp - (min(sensor.new, sensor.believed) if self.frozen(name) else sensor.believed)

    def repetition(self, name: str, stamp: float) -> float:
        """For how long a sensor has repeated itself that should not [s]; 0 for one that does not."""
        return stamp - self._sensors[name].new if self.frozen(name) else 0.0

    def frozen(self, name: str) -> bool:
        """Whether a sensor that should not repeat itself does, while others change."""
        sensor = self._sensors[name]
        if sensor.repeats < REPEATS or sensor.changes < LEARN or sensor.repeats_itself:
            return False
        if self._others_moved(name, sensor.new, STIR if any(sensor.value) else LEAP):
            return True
        return any(sensor.value) and self._all_repeat(sensor.new)

    def _hung(self, name: str, sensor: _Sensor, stamp: float) -> bool:
        """Whether a sensor that repeated itself and does not any more, from `stamp` [s] on, should not have."""
        if sensor.changes < LEARN:
            return False
        if self._all_repeat(sensor.new):
            self._thawed = stamp  # the others follow in this frame
        return self._thawed == stamp or self._others_moved(name, sensor.new, STIR)

    def _all_repeat(self, since: float) -> bool:
        """Whether nothing has been new since then, and that of several sensors which never repeated themselves before:
        whatever reads them hangs, and shows under fresh stamps what it read last."""
        repeating = [s for s in self._sensors.values() if s.repeats >= REPEATS and s.changes >= LEARN]
        return (
            len(repeating) > 1
            and not any(sensor.repeats_itself for sensor in repeating)
            and all(sensor.new <= since for sensor in self._sensors.values())
        )

    def _others_moved(self, name: str, since: float, size: float) -> bool:
        for other, sensor in self._sensors.items():
            if other != name and (sensor.stirred if size == STIR else sensor.leapt) > since:
                return True
        return False


_REPEATED = "repeats itself"


@dataclass
class _Term:
    heard: float
    """When it last said something that the skill can use [s]."""
    flaw: str = ""
    """What is wrong with what it says now."""
    reading: bytes = b""
    """The last one, to the bit."""
    place: tuple[float, float] = (0.0, 0.0)
    """Where that was first said [m]."""
    left: float = math.inf
    """When the robot was driven away from there [s]."""
    lasted: float = 0.0
    """How far from there it was said again [m]."""
    longest: float = 0.0
    """The same of all readings before [m]."""
    changes: int = 0
    repeats_itself: bool = False


class TermWatch:
    """Remembers when each sensor that only the skill needs last said something that it can use: lidar, robot's own.

    They may be without noise, and say the same for as long as the robot stands. One that changes under way and then
    repeats itself to the bit while the robot is driven, much farther than ever before, is frozen, unless it reads
    nothing but zeros, as a lidar does where nothing is near. One that is driven so before it has changed often, a
    gripper say, is not judged.
    """

    def __init__(self, sizes: Mapping[str, int] | None = None) -> None:
        """
        Args:
            sizes: how many values each sensor gives, of those that are watched; None: all are, whatever their sizes.
        """
        self._sizes = sizes
        self._terms: dict[str, _Term] = {}

    def begin_again(self, stamp: float) -> None:
        """The robot's clock is another one from `stamp` [s] on: forget all readings, not which sensors repeat them."""
        for name, term in self._terms.items():
            longest = max(term.longest, term.lasted)
            self._terms[name] = _Term(stamp, longest=longest, repeats_itself=term.repeats_itself)

    def renew(self, stamp: float, place: tuple[float, float]) -> None:
        """Somebody acknowledged the fault: a reading that repeats itself is judged anew from `place` [m] on."""
        for term in self._terms.values():
            if term.flaw == _REPEATED:
                term.heard, term.flaw, term.place, term.left = stamp, "", place, math.inf

    def see(self, name: str, value: np.ndarray, stamp: float, place: tuple[float, float]) -> None:
        """Take note of a reading at `stamp` [s].

        Args:
            name: of the sensor.
            value: of any shape.
            stamp: of its frame [s].
            place: where it was driven to by dead reckoning, from wherever that began [m].
        """
        size = np.size(value)
        if self._sizes is None:
            wanted = size
        elif name in self._sizes:
            wanted = self._sizes[name]
        else:
            return
        term = self._terms.get(name)
        if term is None:
            term = self._terms[name] = _Term(stamp)
        if size != wanted:
            term.flaw = f"{size} values instead of {wanted}"
            return
        if not is_sound(name, value):
            term.flaw = "not finite, or absurd" if name != "lidar" else "not in [0, 1]: closeness is expected"
            return
        reading, term.flaw = np.asarray(value).tobytes(), ""
        if reading != term.reading:
            term.changes += place != term.place
            term.longest = max(term.longest, term.lasted)
            term.reading, term.place, term.left, term.lasted = reading, place, math.inf, 0.0
        elif place != term.place and not term.repeats_itself and np.any(value):
            way, term.left = math.dist(place, term.place), min(term.left, stamp)
            if way > max(TRAVEL, SPARE * term.longest):
                if term.changes > LEARN:
                    term.heard, term.flaw, term.lasted = min(term.heard, term.left), _REPEATED, 0.0
                    return
                term.repeats_itself = True
            term.lasted = max(term.lasted, way)
        term.heard = stamp

    def silences(self, stamp: float) -> Iterator[tuple[str, float, str]]:
        """Each sensor, for how long it has said nothing that can be used [s], and what is wrong with what it says."""
        for name, term in self._terms.items():
            yield name, stamp - term.heard, term.flaw
