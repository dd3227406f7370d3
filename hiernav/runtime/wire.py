"""Sensor frames and commands as bytes, for a robot that lives in another process."""

from __future__ import annotations

import struct

import msgspec
import numpy as np

from hiernav.runtime.robot import SensorFrame, Truth

CAPACITY = 16384
"""Bytes that a frame may take."""


class _Frame(msgspec.Struct, array_like=True):
    stamp: float
    accelerometer: list[float] | None
    gyro: list[float] | None
    magnetometer: list[float] | None
    velocimeter: list[float] | None
    lidar: list[float] | None
    extra: dict[str, list[float]]
    position_fix: list[float] | None
    fix_stamp: float | None
    rotation: list[float] | None
    truth: tuple[float, list[float], list[float], float, bool, int] | None


_GIVEN = struct.Struct("<d")
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Frame)


def encode_frame(frame: SensorFrame, truth: Truth | None) -> bytes:
    """A frame, and the truth of a simulated robot."""
    return _encoder.encode(
        _Frame(
            float(frame.stamp),
            _list(frame.accelerometer),
            _list(frame.gyro),
            _list(frame.magnetometer),
            _list(frame.velocimeter),
            _list(frame.lidar),
            {name: np.asarray(value, np.float64).ravel().tolist() for name, value in frame.extra.items()},
            _list(frame.position_fix),
            None if frame.fix_stamp is None else float(frame.fix_stamp),
            _list(frame.rotation),
            None
            if truth is None
            else (
                truth.time,
                truth.pose.tolist(),
                truth.velocity.tolist(),
                truth.upright,
                truth.collided,
                truth.collisions,
            ),
        )
    )


def decode_frame(message: bytes) -> tuple[SensorFrame, Truth | None]:
    """Inverse of `encode_frame`.

    Raises:
        msgspec.DecodeError: other bytes.
    """
    m = _decoder.decode(message)
    frame = SensorFrame(
        m.stamp,
        _array(m.accelerometer),
        _array(m.gyro),
        _array(m.magnetometer),
        _array(m.velocimeter),
        _array(m.lidar),
        {name: np.array(value) for name, value in m.extra.items()},
        _array(m.position_fix),
        m.fix_stamp,
        _array(m.rotation),
    )
    if m.truth is None:
        return frame, None
    time, pose, velocity, upright, collided, collisions = m.truth
    return frame, Truth(time, np.array(pose), np.array(velocity), upright, collided, collisions)


def encode_command(action: np.ndarray | None, given: float) -> bytes:
    """A command (A,), or the brake if None, that was given at `given` on the monotonic clock [s]."""
    return _GIVEN.pack(given) + (b"" if action is None else np.asarray(action, np.float64).tobytes())


def decode_command(message: bytes) -> tuple[np.ndarray | None, float]:
    """Inverse of `encode_command`."""
    (given,) = _GIVEN.unpack_from(message)
    body = message[_GIVEN.size :]
    return (np.frombuffer(body, np.float64) if body else None), given


def _list(value: np.ndarray | None) -> list[float] | None:
    return None if value is None else np.asarray(value, np.float64).ravel().tolist()


def _array(value: list[float] | None) -> np.ndarray | None:
    return None if value is None else np.array(value)
