"""Programs in the place of the live page."""

from __future__ import annotations

import sys

import numpy as np

from hiernav.view.link import ViewerLink

PREAMBLE = """
import json, socket, sys, time
link = socket.socket(fileno=int(sys.argv[-1]))
settings = json.loads(link.recv(100000))
def say(**values): link.send(json.dumps(values).encode())
say(kind="ready", text="http://127.0.0.1:1")
"""


class Asked:
    """Notes what it is asked for."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def set_goal(self, goal):
        if not np.isfinite(goal).all():
            raise ValueError("goal")
        self.calls.append(("goal", *goal.tolist()))

    def estop(self, why):
        self.calls.append(("estop",))

    def __getattr__(self, name):
        return lambda: self.calls.append((name,))


def link_to(program: str, control=None, **settings) -> ViewerLink:
    return ViewerLink(control or Asked(), 0.1, 0.3, program=(sys.executable, "-c", PREAMBLE + program), **settings)
