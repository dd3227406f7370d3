"""The OpenGL back end MuJoCo draws with: settled by MUJOCO_GL at the moment mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os
import sys


def choose_gl() -> None:
    """Import mujoco so that it can draw, without a display where there is none; MUJOCO_GL is respected if it is set.

    Raises:
        ValueError: mujoco cannot be imported with that back end.
    """
    if sys.platform == "linux" and not (os.environ.get("MUJOCO_GL") or os.environ.get("DISPLAY")):
        os.environ["MUJOCO_GL"] = "egl" if ctypes.util.find_library("EGL") else "osmesa"
    try:
        import mujoco  # noqa: F401
    except Exception as error:  # whatever a library that is missing leads to
        raise no_gl(error) from error


def no_gl(error: Exception) -> ValueError:
    """What to tell a user whose MuJoCo cannot draw."""
    return ValueError(
        f"MuJoCo cannot draw with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')} ({error}): install EGL (on Debian "
        "libegl1, and libgl1-mesa-dri where there is no graphics card) and set MUJOCO_GL=egl, or OSMesa (libosmesa6) "
        "and set MUJOCO_GL=osmesa; the view from above needs neither"
    )
