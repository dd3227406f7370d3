"""The account of a run: as JSON for machines, as tables for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hiernav.runtime.account import Account, Episode
from hiernav.runtime.loop import FixedRateLoop
from hiernav.runtime.timing import TickTimer

SHOWN, SHOWN_FAULTS = 100, 10
"""Episodes and faults on the screen, the newest."""


def summarise(account: Account, timer: TickTimer, loop: FixedRateLoop, realtime: Mapping[str, str]) -> dict[str, Any]:
    """Everything worth knowing about the runs, in JSON's own types; times in seconds.

    Args:
        account: of the runs.
        timer: of the ticks of all runs.
        loop: that paced them.
        realtime: what the system granted (`request_realtime`).
    """
    return {
        "episodes": [_episode(episode) for episode in account.episodes],
        "ends": dict(account.ends),
        "faults": {"count": account.fault_count, "newest": [asdict(fault) for fault in account.faults]},
        "timing": {
            "period": loop.period,
            "rate": _rate(loop),
            "ticks": loop.ticks,
            "overruns": loop.overruns,
            "lateness": loop.lateness.summary(),
            "tick": timer.tick.summary(),
            "sections": {name: histogram.summary() for name, histogram in timer.sections.items()},
        },
        "replans": dict(account.replans),
        "plans": dict(account.plans),
        "guard": dict(account.guard),
        "realtime": {**realtime, **({"rehearsal": f"dropped: {loop.unprepared}"} if loop.unprepared else {})},
    }


def print_summary(summary: Mapping[str, Any], console: Console) -> None:
    """Show a summary made by `summarise`."""
    console.print(_episode_table(summary["episodes"], summary["ends"]))
    console.print(_timing_table(summary["timing"]))
    for title in ("ends", "replans", "plans", "guard"):
        counts = ", ".join(f"{name} {count}" for name, count in sorted(summary[title].items())) or "none"
        console.print(f"{title}: {counts}")
    console.print(f"faults: {summary['faults']['count'] or 'none'}")
    for fault in summary["faults"]["newest"][-SHOWN_FAULTS:]:
        after = ", acknowledged" if fault["acknowledged"] else ""
        console.print(f"  after {fault['seconds']:.1f} s: {fault['why']}{after}", highlight=False, markup=False)
    for name, why in summary.get("dropped_observers", {}).items():
        console.print(f"dropped: {name}, {why}", highlight=False, markup=False)
    granted = ", ".join(f"{name} {text}" for name, text in summary["realtime"].items()) or "not asked"
    console.print(f"real time: {granted}", highlight=False)
    if summary.get("settings"):
        changed = ", ".join(f"{name} {value}" for name, value in summary["settings"].items())
        console.print(f"settings that are not the defaults: {changed}", highlight=False, markup=False)


def _rate(loop: FixedRateLoop) -> float:
    """Ticks per second while the loop ran, by its own clock: what lies between two runs is no driving time."""
    deadlines = loop.ticks + loop.overruns
    return loop.ticks / (deadlines * loop.period) if deadlines else 0.0


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


def _episode_table(episodes: Sequence[Mapping[str, Any]], ends: Mapping[str, int]) -> Table:
    total = sum(ends.values())
    hidden = f" (the newest {SHOWN} are shown)" if len(episodes) > SHOWN else ""
    table = Table(title=f"{ends.get('goal', 0)} of {total} goals reached{hidden}", title_justify="left")
    for column in ("seed", "end", "steps", "time [s]", "collisions", "replans", "stopped"):
        table.add_column(column, justify="left" if column in ("end", "stopped") else "right")
    for episode in episodes[-SHOWN:]:
        end = episode["reason"] if episode["fault"] is None else f"{episode['reason']}: {episode['fault']}"
        table.add_row(
            _text(episode["seed"]),
            escape(end),
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
