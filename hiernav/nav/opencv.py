"""OpenCV as `cv2`, imported without what it does to the environment of the programs that are started from here.

Its own loader puts a path that ends in a colon into LD_LIBRARY_PATH. The empty entry behind the colon is the present
folder: a library that lies there would be loaded by the robot's adapter, the planner and every other child.
"""

from __future__ import annotations

import os

_before = os.environ.get("LD_LIBRARY_PATH")

import cv2  # noqa: E402

if _before is None:
    os.environ.pop("LD_LIBRARY_PATH", None)
else:
    os.environ["LD_LIBRARY_PATH"] = _before

__all__ = ["cv2"]
