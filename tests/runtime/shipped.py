"""The bundles that ship, for tests that need real networks and no torch."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from hiernav.nav.bundle import Bundle, load_bundle

ROOT = Path(__file__).parents[2]
RUN_LOOP = ROOT / "deploy" / "run_loop.py"


@lru_cache
def open_shipped(robot: str) -> Bundle:
    return load_bundle(ROOT / "deploy" / "bundles" / robot)
