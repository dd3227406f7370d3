"""Planar frames: world (x right, y up) and body (x forward, y left). Batch first, float64."""

from __future__ import annotations

import numpy as np


def wrap_angle(angle: np.ndarray | float) -> np.ndarray:
    """Angles wrapped to [-pi, pi) [rad]; pi itself where rounding leads there."""
    return (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def world_to_body(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Express world points in the frame of a robot.

    Args:
        points: (N, K, 2) world frame [m].
        pose: (N, 3) x, y, yaw of the robot [m, m, rad].

    Returns:
        (N, K, 2) body frame [m].
    """
    delta = points - pose[:, None, :2]
    x, y, yaw = delta[..., 0], delta[..., 1], pose[:, 2:]
    cos, sin = np.cos(yaw), np.sin(yaw)
    out = np.empty(delta.shape)
    np.add(cos * x, sin * y, out=out[..., 0])
    np.subtract(cos * y, sin * x, out=out[..., 1])
    return out


def body_to_world(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Inverse of `world_to_body`: (N, K, 2) body frame [m] -> (N, K, 2) world frame [m]."""
    cos, sin = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1) + pose[:, None, :2]
