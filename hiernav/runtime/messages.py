"""What a tick looks like outside of the control loop: JSON messages that recordings consist of and viewers are sent.

Encoding is exact: a decoded `TickRecord` equals the encoded one bit for bit, values that are not finite included.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from hiernav.nav.occupancy import OccupancyMap, check_geometry
from hiernav.nav.termination import TerminationReason
from hiernav.runtime.estimate import Estimate, Trust
from hiernav.runtime.observe import Event, TickRecord
from hiernav.runtime.robot import READINGS, SensorFrame, Truth
from hiernav.runtime.supervisor import Mode

Number = float | Literal["nan", "inf", "-inf"]
Numbers = Annotated[list[Number], msgspec.Meta(max_length=4096)]
Scalars = dict[str, float | int | str | bool | None]
_UPPER = np.triu_indices(6)


class MessageError(ValueError):
    """A message that no recorder has written."""


class Message(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays are flat lists, numbers that are not finite are texts; units are those of the runtime's classes."""


class Sensors(Message, frozen=True):
    """`SensorFrame`."""

    stamp: Number
    accelerometer: Numbers | None
    gyro: Numbers | None
    magnetometer: Numbers | None
    velocimeter: Numbers | None
    lidar: Numbers | None
    extra: dict[str, Numbers]
    position_fix: Numbers | None
    fix_stamp: Number | None
    rotation: Numbers | None = None


class State(Message, frozen=True):
    """`Estimate`; of the covariance the upper triangle, row by row."""

    stamp: Number
    pose: Numbers
    velocity: Numbers
    covariance: Numbers
    upright: Number
    yaw_rate: Number
    trust: Literal[0, 1, 2]
    why: str
    restarts: int


class TruthMessage(Message, frozen=True):
    """`Truth`."""

    time: Number
    pose: Numbers
    velocity: Numbers
    upright: Number
    collided: bool
    collisions: int


class Plan(Message, frozen=True):
    """Waypoints that are followed from this tick on."""

    waypoints: Numbers
    """x and y of each in turn."""
    start: Numbers | None
    stamp: Number | None


class Action(Message, frozen=True):
    """What the skill saw and said, and what came of it."""

    observation: Numbers | None
    proposed: Numbers | None
    sent: Numbers | None
    speed_scale: Number


class Map(Message, frozen=True):
    """An `OccupancyMap` from this tick on: its pixels row by row, eight to a byte, deflated."""

    rows: int
    columns: int
    resolution: float
    origin: tuple[float, float]
    pixels: bytes


class Tick(Message, frozen=True):
    """The rest of a `TickRecord`; the last message of its tick."""

    run: int
    index: int
    time: Number
    lateness: Number
    mode: str
    goal: Numbers | None
    reason: str
    replanned: bool
    plan_age: Number | None
    with_map: bool
    """Whether the tick knew the map of the last map message."""
    with_plan: bool
    """Whether it followed the waypoints of the last plan message."""
    timings: dict[str, float]
    recovering: bool | None = None
    """None in recordings from before it was told: they say as much by the mode, but not where the robot was held."""


class EventMessage(Message, frozen=True):
    """`Event`."""

    time: Number
    kind: str
    text: str
    values: Scalars


TOPICS: dict[str, type[Message]] = {
    "/sensors": Sensors,
    "/estimate": State,
    "/truth": TruthMessage,
    "/map": Map,
    "/plan": Plan,
    "/action": Action,
    "/event": EventMessage,
    "/tick": Tick,
}


def _plain(value: Any) -> Any:
    """A numpy scalar as Python's own number."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be recorded")


_encode = msgspec.json.Encoder(enc_hook=_plain).encode
_decoders = {topic: msgspec.json.Decoder(kind) for topic, kind in TOPICS.items()}


def decode(topic: str, data: bytes) -> Message:
    """One message of a known topic.

    Raises:
        MessageError: not what the topic holds.
    """
    try:
        return _decoders[topic].decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"{topic}: {error}") from None


class TickEncoder:
    """Turns records into messages; maps and plans only where they have changed."""

    def __init__(self) -> None:
        self._run = -1
        self._next_index = 0
        self._map: OccupancyMap | None = None
        self._plan: np.ndarray | None = None

    def encode(self, record: TickRecord) -> Iterable[tuple[str, bytes]]:
        """Topic and message, in the order in which they are to be read."""
        if record.index < self._next_index or self._run < 0:
            self._run += 1
            self._map = self._plan = None
        self._next_index = record.index + 1
        yield "/sensors", _encode(_sensors(record.frame))
        if record.estimate is not None:
            yield "/estimate", _encode(_state(record.estimate))
        if record.truth is not None:
            yield "/truth", _encode(_truth(record.truth))
        if record.occupancy is not None and record.occupancy is not self._map:
            self._map = record.occupancy
            yield "/map", _encode(encode_map(record.occupancy))
        plan = record.plan
        if plan is not None and (record.replanned or self._plan is None or not np.array_equal(plan, self._plan)):
            self._plan = plan
            yield "/plan", _encode(Plan(_numbers(plan), _numbers(record.plan_start), _number(record.plan_stamp)))
        if record.proposed is not None or record.sent is not None:
            action = Action(
                _numbers(record.observation), _numbers(record.proposed), _numbers(record.sent), record.speed_scale
            )
            yield "/action", _encode(action)
        tick = Tick(
            run=self._run,
            index=record.index,
            time=_number(record.time),
            lateness=_number(record.lateness),
            mode=record.mode.value,
            goal=_numbers(record.goal),
            reason=record.reason.name.lower(),
            replanned=record.replanned,
            plan_age=_number(record.plan_age),
            with_map=record.occupancy is not None,
            with_plan=plan is not None,
            timings=dict(record.timings),
            recovering=record.recovering,
        )
        yield "/tick", _encode(tick)


def encode_event(event: Event) -> bytes:
    values = {name: _number(value) if isinstance(value, float) else value for name, value in event.values.items()}
    return _encode(EventMessage(_number(event.time), event.kind, event.text, values))


class TickDecoder:
    """Puts records together again from messages in the order in which they were written."""

    def __init__(self) -> None:
        self._parts: dict[str, Any] = {}
        self._map: OccupancyMap | None = None
        self._plan: Plan | None = None

    def add(self, message: Message) -> TickRecord | Event | None:
        """Take the next message in; a record or event if it is complete with it.

        Raises:
            MessageError: a message that does not fit the ones before it.
        """
        try:
            return self._add(message)
        except (ValueError, TypeError, KeyError, OverflowError, zlib.error) as error:
            raise MessageError(f"{type(message).__name__.lower()}: {error}") from None

    def _add(self, message: Message) -> TickRecord | Event | None:
        match message:
            case Sensors():
                self._parts = {"frame": _frame(message)}
            case State():
                self._parts["estimate"] = _estimate(message)
            case TruthMessage():
                self._parts["truth"] = Truth(
                    _float(message.time),
                    _array(message.pose),
                    _array(message.velocity),
                    _float(message.upright),
                    message.collided,
                    message.collisions,
                )
            case Map():
                self._map = decode_map(message)
            case Plan():
                self._plan = message
            case Action():
                self._parts |= {
                    "observation": _array(message.observation, np.float32),
                    "proposed": _array(message.proposed, np.float32),
                    "sent": _array(message.sent),
                    "speed_scale": _float(message.speed_scale),
                }
            case EventMessage():
                return Event(_float(message.time), message.kind, message.text, message.values)
            case Tick():
                return self._record(message)
        return None

    def _record(self, tick: Tick) -> TickRecord:
        if "frame" not in self._parts:
            raise ValueError("there is no sensor message before it")
        if tick.with_plan and self._plan is None or tick.with_map and self._map is None:
            raise ValueError("it refers to a plan or map that was not recorded")
        parts, self._parts = self._parts, {}
        plan = self._plan
        if tick.with_plan and plan is not None:
            parts["plan"] = _array(plan.waypoints).reshape(-1, 2)
            parts["plan_start"] = _array(plan.start)
            parts["plan_stamp"] = _float(plan.stamp)
        return TickRecord(
            index=tick.index,
            time=_float(tick.time),
            lateness=_float(tick.lateness),
            mode=Mode(tick.mode),
            goal=_array(tick.goal),
            reason=TerminationReason[tick.reason.upper()],
            replanned=tick.replanned,
            plan_age=_float(tick.plan_age),
            occupancy=self._map if tick.with_map else None,
            timings=tick.timings,
            recovering=tick.mode == Mode.RECOVERING.value if tick.recovering is None else tick.recovering,
            **parts,
        )


def encode_map(occupancy: OccupancyMap) -> Map:
    rows, columns = occupancy.occupied.shape
    pixels = zlib.compress(np.packbits(occupancy.occupied, axis=None).tobytes(), 1)
    x, y = occupancy.origin
    return Map(rows, columns, float(occupancy.resolution), (float(x), float(y)), pixels)


def decode_map(message: Map) -> OccupancyMap:
    """
    Raises:
        ValueError: a geometry that no map has, or another number of pixels than it says.
    """
    shape = (message.rows, message.columns)
    check_geometry(shape, message.resolution, message.origin)
    size = math.prod(shape)
    inflate = zlib.decompressobj()
    packed = inflate.decompress(message.pixels, (size + 7) // 8 + 1)
    if len(packed) != (size + 7) // 8 or not inflate.eof:
        raise ValueError(f"the pixels are not those of {message.columns} x {message.rows}")
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=size)
    return OccupancyMap(bits.astype(bool).reshape(shape), message.resolution, message.origin)


def schema(kind: type[Message]) -> bytes:
    """JSON schema of a message."""
    _, components = msgspec.json.schema_components((kind,))
    return msgspec.json.encode({"title": kind.__name__, **components[kind.__name__]})


def _sensors(frame: SensorFrame) -> Sensors:
    readings = {name: _numbers(getattr(frame, name)) for name in READINGS}
    extra: Mapping[str, Any] = {name: _numbers(value) for name, value in frame.extra.items()}
    return Sensors(stamp=_number(frame.stamp), extra=dict(extra), fix_stamp=_number(frame.fix_stamp), **readings)


def _frame(message: Sensors) -> SensorFrame:
    readings = {name: _array(getattr(message, name)) for name in READINGS}
    extra = {name: _array(value) for name, value in message.extra.items()}
    return SensorFrame(_float(message.stamp), extra=extra, fix_stamp=_float(message.fix_stamp), **readings)


def _state(estimate: Estimate) -> State:
    return State(
        stamp=_number(estimate.stamp),
        pose=_numbers(estimate.pose),
        velocity=_numbers(estimate.velocity),
        covariance=_numbers(estimate.covariance[_UPPER]),
        upright=_number(estimate.upright),
        yaw_rate=_number(estimate.yaw_rate),
        trust=int(estimate.trust),  # type: ignore[arg-type]
        why=estimate.why,
        restarts=estimate.restarts,
    )


def _estimate(message: State) -> Estimate:
    upper = np.zeros((6, 6))
    upper[_UPPER] = _array(message.covariance)
    return Estimate(
        stamp=_float(message.stamp),
        pose=_array(message.pose),
        velocity=_array(message.velocity),
        covariance=np.where(np.tri(6, k=-1, dtype=bool), upper.T, upper),
        upright=_float(message.upright),
        yaw_rate=_float(message.yaw_rate),
        trust=Trust(message.trust),
        why=message.why,
        restarts=message.restarts,
    )


def _truth(truth: Truth) -> TruthMessage:
    return TruthMessage(
        _number(truth.time),
        _numbers(truth.pose),
        _numbers(truth.velocity),
        _number(truth.upright),
        truth.collided,
        truth.collisions,
    )


def _number(value: float | None) -> Any:
    if value is None:
        return None
    value = float(value)
    return value if math.isfinite(value) else str(value)


def _numbers(values: np.ndarray | None) -> Any:
    if values is None:
        return None
    flat = np.asarray(values, dtype=np.float64).ravel()
    numbers = flat.tolist()
    return numbers if np.isfinite(flat).all() else [_number(value) for value in numbers]


def _float(value: Any) -> Any:
    return None if value is None else float(value)


def _array(values: Any, dtype: type = np.float64) -> Any:
    return None if values is None else np.array([float(value) for value in values], dtype=dtype)
