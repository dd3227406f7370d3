"""What a drive looked like."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from hiernav.runtime.clock import process_age
from hiernav.runtime.observe import Event, Observer, TickRecord
from hiernav.sim.layout import Layout

PICTURED = 20_000
"""Ticks of a drive that its picture shows at most."""


class Drive(Observer):
    """What one drive looked like, collected tick by tick for its picture: its end, where it is a long one."""

    def __init__(self) -> None:
        self.path: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.plans: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.collisions: deque[np.ndarray] = deque(maxlen=PICTURED)
        self.armed_age: float | None = None

    def event(self, event: Event) -> None:
        if self.armed_age is None and event.values.get("mode") == "armed":
            self.armed_age = process_age()

    def tick(self, record: TickRecord) -> None:
        if record.truth is None:
            return
        self.path.append(record.truth.pose[:2])
        if record.replanned and record.plan is not None:
            self.plans.append(record.plan)
        if record.truth.collided:
            self.collisions.append(record.truth.pose[:2])

    def draw(self, layout: Layout, file: Path, title: str) -> None:
        from hiernav.draw import draw_layout  # matplotlib takes long to import, and the loop need not wait for it

        collisions = np.array(self.collisions).reshape(-1, 2)
        path = np.array(self.path).reshape(-1, 2)
        draw_layout(layout, file, {"path": path, "plans": list(self.plans), "collisions": collisions, "title": title})
