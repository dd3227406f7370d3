"""Sensor frames and commands as bytes, for a robot that lives in another process."""

from __future__ import annotations

import struct

import msgspec
import numpy as np

from hiernav.runtime.robot import SensorFrame, Truth

CAPACITY = 16384
"""Bytes that a frame may take."""


class _Truth(msgspec.Struct, array_like=True):
    time: float
    pose: list[float]
    velocity: list[float]
    upright: float
    collided: bool
    collisions: int


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
    truth: _Truth | None


_GIVEN = struct.Struct("<d")
_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(_Frame)


def encode_frame(frame: SensorFrame, truth: Truth | None) -> bytes:
    """A frame, and the truth of a simulated robot."""
    return _encoder.encode(
        _Frame(
            stamp=float(frame.stamp),
            accelerometer=_list(frame.accelerometer),
            gyro=_list(frame.gyro),
            magnetometer=_list(frame.magnetometer),
            velocimeter=_list(frame.velocimeter),
            lidar=_list(frame.lidar),
            extra={name: np.asarray(value, np.float64).ravel().tolist() for name, value in frame.extra.items()},
            position_fix=_list(frame.position_fix),
            fix_stamp=None if frame.fix_stamp is None else float(frame.fix_stamp),
            rotation=_list(frame.rotation),
            truth=None
            if truth is None
            else _Truth(
                time=truth.time,
                pose=truth.pose.tolist(),
                velocity=truth.velocity.tolist(),
                upright=truth.upright,
                collided=truth.collided,
                collisions=truth.collisions,
            ),
        )
    )


def decode_frame(message: bytes) -> tuple[SensorFrame, Truth | None]:
    """Inverse of `encode_frame`.

    Raises:
        msgspec.DecodeError: other bytes.
    """
    read = _decoder.decode(message)
    frame = SensorFrame(
        stamp=read.stamp,
        accelerometer=_array(read.accelerometer),
        gyro=_array(read.gyro),
        magnetometer=_array(read.magnetometer),
        velocimeter=_array(read.velocimeter),
        lidar=_array(read.lidar),
        extra={name: np.array(value) for name, value in read.extra.items()},
        position_fix=_array(read.position_fix),
        fix_stamp=read.fix_stamp,
        rotation=_array(read.rotation),
    )
    true = read.truth
    if true is None:
        return frame, None
    return frame, Truth(
        time=true.time,
        pose=np.array(true.pose),
        velocity=np.array(true.velocity),
        upright=true.upright,
        collided=true.collided,
        collisions=true.collisions,
    )


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
