"""Real-time scheduling for the length of a test, where the system grants it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from hiernav.runtime.realtime import RealtimeConfig, request_realtime


@contextmanager
def punctual() -> Iterator[None]:
    request_realtime(RealtimeConfig(lock_memory=False, freeze_gc=False))
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
