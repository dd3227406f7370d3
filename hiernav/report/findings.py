"""Text that says where we stand against the paper and against our own targets; every number in it is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hiernav.report import paper
from hiernav.report.book import Book, Group, curve
from hiernav.reproduce.experiments import ROBOTS, TABLE3_ROBOT, WORLDS
from hiernav.reproduce.results import Result, drive_of
from hiernav.sim.layout import parse_world

STRICT_TARGET = 0.97
SAMPLE_TARGET = (0.9, 500_000)
"""Reach rate, and the environment steps in which the doggo has to get there."""


@dataclass(frozen=True)
class Finding:
    """One target, and whether it is met; None while there is nothing to tell it by."""

    target: str
    met: bool | None
    text: str


def findings(book: Book) -> list[Finding]:
    """All targets, in the order of the page, judged by what is of the settings and bundles of the repository."""
    book = book.current()
    return [
        _paper_table3(book),
        *(_strict(book, robot) for robot in ROBOTS),
        _doggo_steps(book),
        *(_above_baseline(book, robot) for robot in ROBOTS),
        _table2(book),
    ]


def shortfalls(book: Book, robot: str) -> list[str]:
    """A sentence for each world in which the shipped robot misses the strict target: how, and what A* says of why."""
    book, sentences = book.current(), list[str]()
    for world in WORLDS:
        for result in book.group("table3", "shipped", robot, world).done:
            drive = drive_of(result)
            if drive is None or drive.reach_rate >= STRICT_TARGET:
                continue
            failures = drive.episodes - drive.endings.get("goal", 0)
            kinds = sorted(((n, kind) for kind, n in drive.endings.items() if kind != "goal"), reverse=True)
            how = ", ".join(f"{n} by {_ENDINGS.get(kind, kind)}" for n, kind in kinds)
            text = f"{world}: {failures} of {drive.episodes} episodes fail, {how}."
            sentences.append(f"{text} {_blame(book, robot, world, drive.reach_ci95)}".strip())
    return sentences


_ENDINGS = {
    "timeout": "reaching the cap on steps", "fallen": "lying on its back at the cap on steps",
    "left_field": "leaving the field", "physics": "diverging physics",
}  # fmt: skip


def _blame(book: Book, robot: str, world: str, interval: tuple[float, float]) -> str:
    other = book.group("astar", "astar", robot, world).estimate("reach_rate")
    if other is None:
        return "Whether the plans or the skill are the cause is not known: A* as planner was not run with this bundle."
    low, high = interval
    if other.low > high:
        return f"With A* plans it reaches {other.mean:.3f}: part of the cause is the learned planner."
    if other.high < low:
        return f"With A* plans it reaches no more than {other.mean:.3f}: the learned planner is not the cause."
    return f"With A* plans it reaches {other.mean:.3f}, no clear difference."


def _paper_table3(book: Book) -> Finding:
    target = (
        "Every cell of Table III at or above the paper's best, under its own protocol "
        "(doggo; ours is trained in more of these worlds than the paper's)"
    )
    missed, met, missing = [], [], []
    for world in paper.TABLE3:
        best_reach, best_steps = paper.best_of_table3(world)
        found, failed, absent = dict[str, tuple[float, float]](), set[str](), set[str]()
        for variant, label in _OURS.items():
            group = book.group("table3", variant, TABLE3_ROBOT, world)
            reach, steps = group.estimate("reach_rate", "paper"), group.estimate("steps_mean", "paper")
            if reach is not None and steps is not None:
                found[label] = reach.mean, steps.mean
            if group.failed:
                failed.add(label)
            if _absent(group, book.seeds("table3", variant, TABLE3_ROBOT, world)):
                absent.add(label)
        good = [label for label, (reach, steps) in found.items() if reach >= best_reach and steps <= best_steps]
        if whole := [label for label in good if label not in failed | absent]:
            met.append(f"{world} ({'; '.join(whole)})")
        elif lacking := [label for label in good if label not in failed]:
            missing.append(f"{world} (seeds of {'; '.join(lacking)})")
        elif good or (failed and not found):
            missed.append(f"{world} (failed: {'; '.join(sorted(failed))})")
        elif found:
            best = max(found, key=lambda label: (found[label][0], -found[label][1]))
            missed.append(f"{world} ({best}: {_how_short(world, *found[best])}{_with_astar(book, world)})")
        else:
            missing.append(world)
    return _verdict(book, target, len(met), missed, missing, "worlds", met)


_OURS = {
    "shipped": "shipped",
    "ours": "trained seeds",
    "shipped-finetuned": "shipped, fine-tuned",
    "finetuned": "trained seeds, fine-tuned",
}
"""Variants of Table III, any of which may meet the paper's best -> what they are called."""


def _how_short(world: str, reach: float, steps: float) -> str:
    """Where a variant falls short of the paper's best in a world."""
    best_reach, best_steps = paper.best_of_table3(world)
    short = []
    if reach < best_reach:
        short.append(f"reach rate {reach:.3f} against {best_reach:.2f}")
    if steps > best_steps:
        # a failure counts as the cap
        arriving = (steps - (1.0 - reach) * parse_world(world).max_steps) / max(reach, 1e-9)
        short.append(f"{steps:.1f} steps against {best_steps:.1f}, {arriving:.1f} where it reaches the goal")
    return ", ".join(short)


def _with_astar(book: Book, world: str) -> str:
    """What A* in the place of the shipped robot's planner says of why, where that was driven."""
    group = book.group("astar", "astar", TABLE3_ROBOT, world)
    reach, steps = group.estimate("reach_rate", "paper"), group.estimate("steps_mean", "paper")
    if reach is None or steps is None:
        return ""
    best_reach, best_steps = paper.best_of_table3(world)
    still = reach.mean < best_reach or steps.mean > best_steps
    why = "the skill falls short, whoever plans" if still else "the learned planner is the cause"
    return f"; with A* plans the shipped one reaches {reach.mean:.3f} in {steps.mean:.1f} steps: {why}"


def _strict(book: Book, robot: str) -> Finding:
    target = (
        f"Reach rate of at least {STRICT_TARGET} in every world under the strict protocol ({robot}, shipped bundle)"
    )
    missed, met, missing = [], 0, []
    for world in WORLDS:
        group = book.group("table3", "shipped", robot, world)
        estimate = group.estimate("reach_rate")
        if group.failed:
            missed.append(f"{world} (failed)")
        elif estimate is None:
            missing.append(world)
        elif estimate.mean >= STRICT_TARGET:
            met += 1
        else:
            missed.append(f"{world} ({estimate.mean:.3f})")
    return _verdict(book, target, met, missed, missing, "worlds")


def _doggo_steps(book: Book) -> Finding:
    rate, limit = SAMPLE_TARGET
    target = f"The doggo reaches {rate} within {limit:,} environment steps (the paper trained {paper.TRAINING_STEPS:,})"
    results = _by_seed(book.group("sample_efficiency", "ours", "doggo"))
    missed, met, missing = [], 0, []
    for seed in book.seeds("sample_efficiency", "ours", "doggo"):
        result = results.get(seed)
        first = None if result is None else steps_to(result, rate)
        if result is None:
            missing.append(f"seed {seed}")
        elif result.state == "failed":
            missed.append(f"seed {seed} (failed)")
        elif first is not None and first <= limit:
            met += 1
        else:
            missed.append(f"seed {seed} ({'never' if first is None else f'{first:,.0f} steps'})")
    return _verdict(book, target, met, missed, missing, "seeds")


def _above_baseline(book: Book, robot: str) -> Finding:
    target = f"Ours above the baseline for every seed ({robot}; reach rate, then return by the baseline's reward)"
    ours, theirs = (_by_seed(book.group("sample_efficiency", v, robot)) for v in ("ours", "baseline"))
    missed, met, missing = [], 0, []
    seeds = (book.seeds("sample_efficiency", variant, robot) for variant in ("ours", "baseline"))
    for seed in sorted(set().union(*seeds)):
        pair = {"ours": ours.get(seed), "the baseline": theirs.get(seed)}
        if failed := [name for name, result in pair.items() if result is not None and result.state == "failed"]:
            missed.append(f"seed {seed} ({' and '.join(failed)} failed)")
            continue
        if absent := [name for name, result in pair.items() if result is None]:
            missing.append(f"seed {seed} of {' and '.join(absent)}")
            continue
        a, b = drive_of(ours[seed]), drive_of(theirs[seed])
        assert a is not None and b is not None, "a training ends with a drive"
        earned = a.return_mean is not None and b.return_mean is not None and a.return_mean > b.return_mean
        if a.reach_rate > b.reach_rate or (a.reach_rate == b.reach_rate and earned):
            met += 1
        else:
            missed.append(f"seed {seed} ({a.reach_rate:.3f} against {b.reach_rate:.3f})")
    return _verdict(book, target, met, missed, missing, "seeds")


def _table2(book: Book) -> Finding:
    target = "Fewer collisions of plans than in Table II, for every number of samples (our network)"
    missed, met, missing = [], 0, []
    for samples, printed in paper.TABLE2.items():
        group = book.group("table2", "default", samples=samples)
        values = [result.metrics["collisions_mean"] for result in group.done]
        absent = _absent(group, book.seeds("table2", "default", "point", samples=samples))
        if group.failed:
            missed.append(f"{samples:,} ({len(group.failed)} failed)")
        elif absent or not values:
            missing.append(f"{samples:,}" + (f" (seeds {', '.join(map(str, absent))})" if values else ""))
        elif np.mean(values) <= printed:
            met += 1
        else:
            missed.append(f"{samples:,} ({np.mean(values):.2f} against {printed:.2f})")
    return _verdict(book, target, met, missed, missing, "sizes")


def steps_to(result: Result, rate: float) -> float | None:
    """Environment steps after which an evaluation first reached a rate, None if none did."""
    steps, values = curve(result, "reach_rate")
    reached = np.flatnonzero(values >= rate)
    return float(steps[reached[0]]) if len(reached) else None


def _by_seed(group: Group) -> dict[int, Result]:
    return {result.seed: result for result in (*group.done, *group.failed) if result.seed is not None}


def _absent(group: Group, planned: Sequence[int]) -> list[int]:
    """Seeds that a group lacks of those that there are to run."""
    return sorted(set(planned) - _by_seed(group).keys())


def _verdict(
    book: Book,
    target: str,
    met: int,
    missed: Sequence[str],
    missing: Sequence[str],
    what: str,
    met_by: Sequence[str] = (),
) -> Finding:
    if not met and not missed and not missing:
        missing = [f"no {what}"]
    total = met + len(missed) + len(missing)
    parts = []
    if missed:
        parts.append(f"missed: {', '.join(missed)}")
    if missing:
        how = ", or with older settings or an older bundle alone" if book.left_out else ""
        parts.append(f"not run yet{how}: {', '.join(missing)}")
    if met:
        parts.insert(0, f"met for {met} of {total} {what}{': ' if met_by else ''}{', '.join(met_by)}")
    state = False if missed else None if missing else True
    return Finding(target, state, "; ".join(parts))
