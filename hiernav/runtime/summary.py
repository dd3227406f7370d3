"""The account of a run: as JSON for machines, as tables for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from hiernav.runtime.loop import FixedRateLoop
from hiernav.runtime.timing import TickTimer
from hiernav.runtime.trip import RunResult


@dataclass(frozen=True)
class Episode:
    """One run, with what only its surroundings know."""

    seed: int | None
    result: RunResult
    collisions: int | None = None
    """Control steps with contact; None where nothing measures it."""
    true_distance: float | None = None
    """From the true position to the goal [m]; None where it is not known."""


def summarise(
    episodes: Sequence[Episode], timer: TickTimer, loop: FixedRateLoop, realtime: Mapping[str, str]
) -> dict[str, Any]:
    """Everything worth knowing about the runs, in JSON's own types; times in seconds.

    Args:
        episodes: the runs, in order.
        timer: of the ticks of all runs.
        loop: that paced them.
        realtime: what the system granted (`request_realtime`).
    """
    replans: Counter[str] = Counter()
    plans: Counter[str] = Counter()
    for episode in episodes:
        replans.update(episode.result.replans)
        plans.update(episode.result.planner)
    return {
        "episodes": [_episode(episode) for episode in episodes],
        "timing": {
            "period": loop.period,
            "rate": timer.rate,
            "ticks": loop.ticks,
            "overruns": loop.overruns,
            "lateness": loop.lateness.summary(),
            "tick": timer.tick.summary(),
            "sections": {name: histogram.summary() for name, histogram in timer.sections.items()},
        },
        "replans": dict(replans),
        "plans": dict(plans),
        "realtime": dict(realtime),
    }


def print_summary(summary: Mapping[str, Any], console: Console | None = None) -> None:
    """Show a summary made by `summarise`."""
    console = console or Console()
    console.print(_episode_table(summary["episodes"]))
    console.print(_timing_table(summary["timing"]))
    for title in ("replans", "plans"):
        counts = ", ".join(f"{name} {count}" for name, count in sorted(summary[title].items())) or "none"
        console.print(f"{title}: {counts}")
    granted = ", ".join(f"{name} {text}" for name, text in summary["realtime"].items()) or "not asked"
    console.print(f"real time: {granted}", highlight=False)


def _episode(episode: Episode) -> dict[str, Any]:
    result = episode.result
    return {
        "seed": episode.seed,
        "reached": result.reached,
        "reason": result.reason,
        "steps": result.steps,
        "seconds": result.seconds,
        "collisions": episode.collisions,
        "distance": result.distance if result.distance == result.distance else None,
        "true_distance": episode.true_distance,
        "stopped": result.stopped,
        "fault": result.fault,
        "detail": result.detail,
        "holds": dict(result.holds),
        "recoveries": result.recoveries,
        "planner": dict(result.planner),
        "replans": dict(result.replans),
        "guard": dict(result.guard),
        "estimator": dict(result.estimator),
    }


def _episode_table(episodes: Sequence[Mapping[str, Any]]) -> Table:
    reached = sum(episode["reached"] for episode in episodes)
    table = Table(title=f"{reached} of {len(episodes)} goals reached", title_justify="left")
    for column in ("seed", "end", "steps", "time [s]", "collisions", "replans", "stopped"):
        table.add_column(column, justify="left" if column in ("end", "stopped") else "right")
    for episode in episodes:
        end = episode["reason"] if episode["fault"] is None else f"{episode['reason']}: {episode['fault']}"
        table.add_row(
            _text(episode["seed"]),
            end,
            str(episode["steps"]),
            f"{episode['seconds']:.1f}",
            _text(episode["collisions"]),
            str(sum(episode["replans"].values())),
            "yes" if episode["stopped"] else "no",
        )
    return table


def _timing_table(timing: Mapping[str, Any]) -> Table:
    title = f"{timing['rate']:.1f} ticks/s, period {timing['period'] * 1e3:g} ms, {timing['overruns']} overruns"
    table = Table(title=title, title_justify="left")
    table.add_column("section")
    for column in ("count", "p50 [ms]", "p99 [ms]", "max [ms]"):
        table.add_column(column, justify="right")
    rows = {"lateness": timing["lateness"], "tick": timing["tick"], **timing["sections"]}
    for name, entry in rows.items():
        times = ("-" if entry[key] is None else f"{entry[key] * 1e3:.3f}" for key in ("p50", "p99", "max"))
        table.add_row(name, str(entry["count"]), *times)
    return table


def _text(value: object) -> str:
    return "-" if value is None else str(value)
