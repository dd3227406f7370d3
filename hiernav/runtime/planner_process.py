"""The planner in a process of its own: a keeper starts it, restarts it where it dies or hangs, and ends it.

Run as `python -P -m hiernav.runtime.planner_process NEWS QUESTIONS MEMORY` by `ProcessPlanner`. The keeper has imported
everything before it forks the planner, so that a restart takes milliseconds, and none of them in the control process.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import sys
import time

import msgspec
import numpy as np
import scipy.sparse.csgraph  # noqa: F401  by the first search, which the keeper is to have imported

from hiernav.nav.goselo import PIXELS
from hiernav.nav.option import Planner, PlanQuery
from hiernav.nav.planners import VerifiedPlanner
from hiernav.runtime.child import leave_signals_to_parent, wait_for_news
from hiernav.runtime.mailbox import mapped
from hiernav.runtime.planner_memory import PlannerMemory, Reply
from hiernav.runtime.policy import OnnxPlannerNetwork, PlannerSettings

MAX_RESTARTS = 3
RESTART, FORGIVE = b"r", b"f"
START_AGAIN = 0.1
"""Where the system had no room for another process, it is asked again after this long [s]."""


def main() -> None:
    news, questions, descriptor = map(int, sys.argv[1:4])
    leave_signals_to_parent()
    keep(news, questions, PlannerMemory(mapped(descriptor)))


def keep(news: int, questions: int, memory: PlannerMemory) -> None:
    """Keep one planner running until the control process closes `news`, with `MAX_RESTARTS` restarts."""
    gc.freeze()
    planner, watched = _start(news, questions, memory)
    while True:
        wait = None if planner or memory.status.exhausted else START_AGAIN
        ready = select.select([news, watched] if watched >= 0 else [news], [], [], wait)[0]
        wish = wait_for_news(news, 0.0) if news in ready else b""
        if wish is None:
            break
        if RESTART in wish and planner:
            os.kill(planner, signal.SIGKILL)
        if FORGIVE in wish:
            memory.set_status("restarts", 0)
        if planner and (watched in ready or RESTART in wish):
            os.waitpid(planner, 0)
            os.close(watched)
            planner, watched = 0, -1
        if not planner:
            exhausted = memory.status.restarts >= MAX_RESTARTS
            memory.set_status("exhausted", int(exhausted))  # before the start, by which it is told to be over
            if not exhausted:
                memory.set_status("restarts", memory.status.restarts + 1)
                planner, watched = _start(news, questions, memory)
    if planner:
        os.kill(planner, signal.SIGKILL)
        os.waitpid(planner, 0)


def _start(news: int, questions: int, memory: PlannerMemory) -> tuple[int, int]:
    """Number and descriptor of a new planner; 0 and -1 where the system has no room for one."""
    memory.set_status("starts", memory.status.starts + 1)
    try:
        pid = os.fork()
    except OSError:
        return 0, -1
    if pid == 0:
        code = 1
        try:
            os.close(news)
            memory = memory.reopened()  # goes on where the last planner ended
            answer_questions(questions, memory, make_planner(memory))
            code = 0
        finally:
            os._exit(code)
    try:
        watched = os.pidfd_open(pid)
    except OSError:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return 0, -1
    memory.set_status("pid", pid)
    return pid, watched


def make_planner(memory: PlannerMemory) -> Planner:
    """The planner that the settings describe, warmed up by one question."""
    settings = msgspec.json.decode(memory.settings, type=PlannerSettings)
    network = OnnxPlannerNetwork(memory.model)
    network(np.zeros((1, network.channels, PIXELS, PIXELS), np.uint8), np.ones(1, np.float32))
    return settings.planner_of(network)


def answer_questions(questions: int, memory: PlannerMemory, planner: Planner) -> None:
    """Answer the newest question again and again, until the control process closes `questions`."""
    start = memory.status.starts
    memory.set_status("ready", start)
    version, occupancy = -1, None
    while wait_for_news(questions, None) is not None:
        question = memory.question()
        if question is None:
            continue
        if question.map_version != version:
            version, occupancy = question.map_version, memory.read_map(question.map_version)
        if occupancy is None:  # a newer map, and a newer question with it, are on their way
            version = -1
            continue
        began = time.perf_counter()
        query = PlanQuery(
            question.position[None],
            question.goal[None],
            [occupancy],
            [memory.read_visits(occupancy)],
            question.previous[None],
        )
        plan = planner.plan(query)[0]
        counts = planner.counts() if isinstance(planner, VerifiedPlanner) else {}
        memory.reply(Reply(question.number, plan, time.perf_counter() - began, start, counts))


if __name__ == "__main__":
    main()
