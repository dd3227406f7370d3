"""The tables of the page: the paper's numbers beside ours, and "not run yet" where there are none."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

import msgspec

from hiernav.report import paper
from hiernav.report.book import Book, Estimate, Group, of_seeds
from hiernav.reproduce.experiments import (
    DEPARTURE_WORLDS,
    DRIVING,
    PERIODS,
    ROBOTS,
    TABLE3_ROBOT,
    TRAINING,
    UNSEEN,
    WORLDS,
    table2_updates,
)
from hiernav.reproduce.results import PlanWalks

NOT_RUN = '<span class="none">not run yet</span>'
_DIGITS = {"reach_rate": 3, "steps_mean": 1, "collisions_mean": 2, "collision_free_rate": 3, "spl_mean": 3}
_DIGITS["steps_between_plans"] = 1
_HEADS = {
    "reach_rate": "reach rate", "steps_mean": "steps", "collisions_mean": "collisions",
    "collision_free_rate": "collision-free", "spl_mean": "SPL", "steps_between_plans": "steps between plans",
}  # fmt: skip
VARIANTS = {
    "baseline": "baseline",
    "shipped": "ours, shipped bundle",
    "ours": "ours, trained seeds",
    "shipped-finetuned": "shipped, planner fine-tuned",
    "finetuned": "trained seeds, planner fine-tuned",
}
WHAT = {
    "no-repair": "plans are not verified or repaired", "no-recovery": "a robot that stands still gets no way out",
    "no-invalid-rule": "plans are kept that meet the map, or were made on another one",
    "no-prediction": "plans are made on maps as they are, not as they will be", "paper-reward": "the paper's reward",
    "one-world": "trained in pillar(2,2,10) alone, as in the paper", "no-phase-in": "all worlds from the start",
    "no-mirror": "batches are not reflected", "no-average": "the last actor instead of the average",
    "no-alpha-floor": "no floor of the temperature", "no-tilt-cost": "no cost of tilting",
    "no-time-cost": "no cost of time", "go-on-after-fall": "training goes on after a fall",
    "no-clock": "no gait clock", "layer-norm": "with layer normalisation in the critics",
    "learned-plans": "trained with the network's plans", "world-frame": "waypoints in the world frame",
}  # fmt: skip
"""Ablation -> what differs."""


def training_worlds(book: Book) -> str:
    """Worlds that the networks of Table III were trained in, the paper's and ours."""
    rows = [["the paper, doggo", *[f'<span class="theirs">{escape(paper.TRAINING_WORLD)}</span>'] * 2]]
    for robot in reversed(ROBOTS):
        worlds = book.training_worlds(robot)
        if worlds is not None:
            rows.append([f"ours, {robot}", *("<br>".join(map(escape, each)) for each in worlds)])
    return table(["planner", "skill, and the baseline"], rows, "trained in")


def table3(book: Book, robot: str, name: str) -> str:
    """The paper's Table III and ours, under the paper's protocol."""
    columns = [  # ours first: a narrow screen shows few
        ("ours", "the paper", None), ("ours", "shipped", "shipped"), ("ours", "trained", "ours"),
        ("finetuned", "the paper", None), ("finetuned", "shipped", "shipped-finetuned"),
        ("finetuned", "trained", "finetuned"), ("baseline", "the paper", None), ("baseline", "ours", "baseline"),
    ]  # fmt: skip
    if robot != TABLE3_ROBOT:
        columns = [column for column in columns if column[2] and book.knows("table3", column[2], robot)]
    rows = []
    for world in WORLDS:
        row = [escape(world)]
        for theirs, _, ours in columns:
            if ours is None:
                printed = paper.table3(robot, world, theirs)
                row.append("–" if printed is None else _printed(printed, name))
            else:
                bar = None if theirs == "baseline" else _bar(robot, world, name)
                row.append(cell(book.group("table3", ours, robot, world), name, "paper", bar))
        rows.append(row)
    groups = {"baseline": "Baseline", "ours": "Ours", "finetuned": "Fine-tuned"}
    return table([f"{groups[theirs]}<br><small>{whose}</small>" for theirs, whose, _ in columns], rows, "world")


def strict(book: Book, robot: str) -> str:
    """Everything that was driven in the six worlds, under the strict protocol."""
    names = ("reach_rate", "steps_mean", "collisions_mean", "collision_free_rate", "spl_mean")
    rows = []
    for world in WORLDS:
        kinds = [("table3", variant, label) for variant, label in VARIANTS.items()]
        for experiment, variant, label in (*kinds, ("astar", "astar", "A* as planner")):
            if not book.knows(experiment, variant, robot):
                continue
            group = book.group(experiment, variant, robot, world)
            rows.append([f"{escape(world)}<br><small>{label}</small>", *(cell(group, name) for name in names)])
    return table([_HEADS[name] for name in names], rows, "world, policies")


def redraws(book: Book) -> str:
    """How many layouts had to be drawn again, in a sentence."""
    parts = []
    for robot in ROBOTS:
        counts = {
            world: result.metrics["strict"].get("redraws", 0)
            for world in WORLDS
            for result in book.group("table3", "shipped", robot, world).done
        }
        again = [f"{count} in {world}" for world, count in counts.items() if count]
        if counts:
            parts.append(f"{robot} {', '.join(again) or 'none'}")
    told = f"so many among the layouts of the strict protocol: {'; '.join(parts)}" if parts else "none was driven yet"
    return f"Layouts that no way leads through for the robot are drawn again; {told}."


def table2(book: Book) -> str:
    """Table II and ours."""
    rows = []
    for samples, printed in paper.TABLE2.items():
        row = [f"{samples:,}", f"{table2_updates(samples):,}", f'<span class="theirs">{printed:.2f}</span>']
        for preset in ("paper", "default"):
            group = book.group("table2", preset, samples=samples)
            estimate = of_seeds([result.metrics["collisions_mean"] for result in group.done], 0.0)
            row.append(_shown(estimate, "collisions_mean", group, printed, fewer=True))
        rows.append(row)
    return table(["our updates", "the paper", "its network, ours", "our network"], rows, "samples")


def walks(book: Book, robot: str) -> str:
    """Plans alone: collisions and reach rate of a disc, whoever plans."""
    rows = []
    for world in (*WORLDS, *UNSEEN):
        group = book.group("walks", "shipped", robot, world)
        notes = ["" if world in WORLDS else "unseen", group.age]
        first = " ".join([escape(world), *(f"<small>{note}</small>" for note in notes if note)])
        for result in group.done:
            found = msgspec.convert(result.metrics, PlanWalks)
            row = [f"{walked.collisions_mean:.3f}" for walked in (found.network, found.verified)]
            row += [f"{walked.reach_rate:.3f}" for walked in (found.network, found.verified, found.astar)]
            share, count = found.verified.repairs, found.verified.proposals
            rows.append([first, *row, f"{100.0 * share / count:.1f} %" if count else "–"])
        rows += [[first, '<span class="short">failed</span>', *["–"] * 5] for _ in group.failed]
        if not (group.done or group.failed):
            rows.append([first, *[NOT_RUN] * 6])
    heads = [f"{what}<br><small>{who}</small>" for what, who in (
        ("collisions", "network"), ("collisions", "verified"), ("reach rate", "network"), ("reach rate", "verified"),
        ("reach rate", "A*"), ("repaired", "of the plans"),
    )]  # fmt: skip
    return table(heads, rows, "world")


def unseen(book: Book, robot: str) -> str:
    """Drives of the shipped bundle in worlds of other sizes and densities."""
    names = ("reach_rate", "steps_mean", "collisions_mean", "collision_free_rate", "spl_mean")
    groups = [(world, book.group("unseen", "shipped", robot, world)) for world in UNSEEN]
    rows = [[escape(world), *(cell(group, name) for name in names)] for world, group in groups]
    return table([_HEADS[name] for name in names], rows, "world")


def replanning(book: Book, robot: str) -> str:
    """Fixed periods against the rule, of the shipped bundle."""
    names = ("steps_between_plans", "reach_rate", "steps_mean", "collisions_mean")
    kinds = [(f"period-{period}", f"every {period} steps") for period in PERIODS]
    return _beside_shipped(book, robot, "replanning", "the rule", kinds, names)


def trained_periods(book: Book, robot: str) -> str:
    """Trainings with fixed periods, driven with A* plans; empty for a robot that is not trained so."""
    kinds = [(robot, f"trained-period-{period}", f"every {period} steps") for period in PERIODS]
    return _trainings(book, "replanning", kinds)


def driving_ablations(book: Book, robot: str) -> str:
    """Departures that were switched off in driving alone."""
    names = ("reach_rate", "steps_mean", "collisions_mean", "collision_free_rate")
    return _beside_shipped(book, robot, "ablations", "as shipped", [(name, WHAT[name]) for name in DRIVING], names)


def trained_ablations(book: Book, robot: str) -> str:
    """Departures that were trained without; empty for a robot that is not trained so."""
    return _trainings(book, "ablations", [(robot, name, WHAT[name]) for name in TRAINING])


def is_empty(html: str) -> bool:
    """Whether nothing in a table was run."""
    return "<td>" not in html


def sample_efficiency(book: Book) -> str:
    """Ends of the trainings, driven with A* plans; returns of both by the baseline's reward."""
    kinds = [(robot, variant, variant) for robot in ROBOTS for variant in ("ours", "baseline")]
    return _trainings(book, "sample_efficiency", kinds)


def _beside_shipped(
    book: Book, robot: str, experiment: str, shipped: str, kinds: Sequence[tuple[str, str]], names: Sequence[str]
) -> str:
    rows = []
    for world in DEPARTURE_WORLDS:
        found = [(label, book.group(experiment, variant, robot, world)) for variant, label in kinds]
        if any(group.done or group.failed for _, group in found):
            found.insert(0, (shipped, book.group("table3", "shipped", robot, world)))
        for label, group in found:
            rows.append([f"{escape(world)}<br><small>{label}</small>", *(cell(group, name) for name in names)])
    return table([_HEADS[name] for name in names], rows, "world")


def _trainings(book: Book, experiment: str, kinds: Iterable[tuple[str, str, str]]) -> str:
    known, rows = [kind for kind in kinds if book.knows(experiment, kind[1], kind[0])], list[list[str]]()
    if not known:
        return ""
    for robot, variant, label in known:
        group = book.group(experiment, variant, robot)
        if experiment != "sample_efficiency" and not rows:
            ours = book.group("sample_efficiency", "ours", robot)
            rows.append(_training(ours, robot, "ours"))
        rows.append(_training(group, robot, label))
    return table([*(_HEADS[name] for name in _TRAINED), "return", "code"], rows, "robot, training")


_TRAINED = ("reach_rate", "steps_mean", "collisions_mean")


def _training(group: Group, robot: str, label: str) -> list[str]:
    """What came of the trainings of a group, and the commits that trained."""
    results = [*group.done, *group.failed]
    code = [name for result in results for name in result.source.get("commits") or [result.commit or "no repository"]]
    shown = "<br>".join(dict.fromkeys(escape(name[:7]) for name in code))
    cells = [cell(group, name) for name in (*_TRAINED, "return_mean")]
    return [f"{robot}<br><small>{label}</small>", *cells, f"<small>{shown}</small>" if shown else NOT_RUN]


def cell(group: Group, name: str, protocol: str = "strict", bar: float | None = None) -> str:
    """A number with its interval, failed seeds and older bundles named; marked if there is a bar to reach."""
    return _shown(group.estimate(name, protocol), name, group, bar, fewer=name != "reach_rate")


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], first: str) -> str:
    """HTML of a table that scrolls by itself on a narrow screen; cells are HTML."""
    head = "".join(f"<th>{text}</th>" for text in (first, *heads))
    body = "".join(f"<tr><th scope=row>{row[0]}</th>{_cells(row[1:])}</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _cells(texts: Sequence[str]) -> str:
    if set(texts) == {NOT_RUN}:
        return f'<td class="all" colspan="{len(texts)}">{NOT_RUN}</td>'
    return "".join(f"<td>{text}</td>" for text in texts)


def _shown(estimate: Estimate | None, name: str, group: Group, bar: float | None, fewer: bool) -> str:
    parts = []
    if estimate is not None:
        mark = ""
        if bar is not None and not group.age:
            met = estimate.mean <= bar if fewer else estimate.mean >= bar
            mark = ' class="met"' if met else ' class="short"'
        parts.append(f"<span{mark}>{_number(estimate.mean, name)}</span>")
        if not math.isnan(estimate.low):
            parts.append(f"<small>{_number(estimate.low, name)} – {_number(estimate.high, name)}</small>")
        if estimate.count > 1:
            parts.append(f"<small>{estimate.count} seeds</small>")
    if group.failed:
        parts.append(f'<span class="short">{len(group.failed)} failed</span>')
    if group.age:
        parts.append(f"<small>{group.age}</small>")
    return "<br>".join(parts) or NOT_RUN


def _number(value: float, name: str) -> str:
    return f"{value:.{_DIGITS.get(name, 2)}f}"


def _printed(pair: tuple[float, float], name: str) -> str:
    """With the digits that the paper prints."""
    reach, steps = pair
    return f'<span class="theirs">{f"{steps:.1f}" if name == "steps_mean" else f"{reach:.2f}"}</span>'


def _bar(robot: str, world: str, name: str) -> float | None:
    """The paper's best of a row of Table III."""
    if robot != TABLE3_ROBOT or world not in paper.TABLE3:
        return None
    return paper.best_of_table3(world)[name == "steps_mean"]
