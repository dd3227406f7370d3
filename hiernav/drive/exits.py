"""Exit codes of `run_loop.py`."""

from __future__ import annotations

OK, FAULT, BAD_INPUT, BAD_BUNDLE, BAD_GOAL = 0, 1, 2, 3, 4
