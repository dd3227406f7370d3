"""Figures as SVG inside the page: their text takes the page's colour and font, so they read light and dark."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from hiernav.report import paper
from hiernav.report.book import Book, curve, of_seeds
from hiernav.reproduce.experiments import PERIODS, ROBOTS, TABLE3_ROBOT, WORLDS

OURS, BASELINE, PAPER, FINE_TUNED, ASTAR = "#3b82c4", "#d97a1f", "#8b8f98", "#3f9b6c", "#9b6bc0"
_INK = "#010203"  # becomes the page's own colour
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "axes.titlecolor"), _INK
    ),
    "axes.titlesize": 10.0,
    "axes.grid": True,
    "grid.color": PAPER,
    "grid.alpha": 0.25,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
}


def table2(book: Book) -> str | None:
    """Collisions of plans against the number of samples; None if nothing was run."""
    groups = {name: book.group("table2", name) for name in ("paper", "default")}
    if not any(group.done for group in groups.values()):
        return None

    def draw(axes: Axes) -> None:
        axes.plot(list(paper.TABLE2), list(paper.TABLE2.values()), "D--", color=PAPER, label="the paper", markersize=5)
        for name, color, label in (("paper", BASELINE, "its network, ours"), ("default", OURS, "our network")):
            sizes = sorted({result.metrics["samples"] for result in groups[name].done})
            means, lows, highs = [], [], []
            for size in sizes:
                values = [r.metrics["collisions_mean"] for r in groups[name].done if r.metrics["samples"] == size]
                estimate = of_seeds(values)
                assert estimate is not None
                axes.plot([size] * len(values), values, ".", color=color, alpha=0.5, markersize=5)
                means.append(estimate.mean)
                lows.append(max(0.0, estimate.mean - estimate.low))
                highs.append(max(0.0, estimate.high - estimate.mean))
            if sizes:
                axes.errorbar(sizes, means, np.nan_to_num([lows, highs]), color=color, label=label, capsize=3)
        axes.set(xscale="log", xlabel="samples", ylabel="collisions in an episode", ylim=(0, None))
        axes.legend()

    return _svg("table2", draw, "Collisions of plans against the number of samples")


def training(book: Book, robot: str, name: str, what: str) -> str | None:
    """One value of the evaluations during training against environment steps, every seed a line."""
    if not any(book.group("sample_efficiency", variant, robot).done for variant in ("ours", "baseline")):
        return None

    def draw(axes: Axes) -> None:
        _draw_training(axes, book, robot, name, what)

    return _svg(f"training-{robot}-{name}", draw, f"{what} during training of the {robot}")


PICTURES = (".png", ".svg", ".pdf")
"""What the name of a picture may end in."""


def save_training(book: Book, out: Path) -> None:
    """Reach rates during the trainings of all robots side by side, as one of `PICTURES`, by its name."""
    figure = Figure(figsize=(11.0, 3.2), dpi=110, layout="constrained")
    for robot, axes in zip(ROBOTS, figure.subplots(1, len(ROBOTS), sharey=True), strict=True):
        _draw_training(axes, book, robot, "reach_rate", "reach rate" if robot == ROBOTS[0] else "")
    figure.savefig(out)


def _draw_training(axes: Axes, book: Book, robot: str, name: str, what: str) -> None:
    for variant, color in (("ours", OURS), ("baseline", BASELINE)):
        results = book.group("sample_efficiency", variant, robot).done
        for steps, values in (curve(result, name) for result in results):
            axes.plot(steps / 1e3, values, color=color, alpha=0.35, linewidth=0.9)
        current = [curve(result, name) for result in results if result.id not in book.changed]
        curves = [(steps, values) for steps, values in current if len(steps)]
        if curves:
            label = f"{variant} ({len(curves)} {'seed' if len(curves) == 1 else 'seeds'})"
            steps, mean = mean_curve(curves)
            axes.plot(steps / 1e3, mean, color=color, linewidth=2.2, label=label)
    if name == "reach_rate":
        axes.axhline(0.9, color=PAPER, linewidth=0.8, linestyle=":")
        axes.set_ylim(-0.02, 1.02)
    axes.set(xlabel="environment steps [thousands]", ylabel=what, title=robot)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False)


def mean_curve(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Steps (T,) and mean (T,) of curves, between their evaluations on straight lines, as far as all of them go."""
    steps = np.unique(np.concatenate([each for each, _ in curves]))
    first, last = max(each[0] for each, _ in curves), min(each[-1] for each, _ in curves)
    steps = steps[(steps >= first) & (steps <= last)]
    return steps, np.mean([np.interp(steps, *each) for each in curves], axis=0)


def reach(book: Book, robot: str) -> str | None:
    """Reach rate under the strict protocol in every world, with 95 % intervals."""
    rows = (
        ("table3", "baseline", BASELINE, "baseline"),
        ("table3", "shipped", OURS, "ours, shipped"),
        ("table3", "ours", "#1d4f80", "ours, trained seeds"),
        ("table3", "finetuned", FINE_TUNED, "fine-tuned"),
        ("astar", "astar", ASTAR, "A* plans"),
    )
    found = [
        (label, color, [book.group(experiment, variant, robot, world).estimate("reach_rate") for world in WORLDS])
        for experiment, variant, color, label in rows
    ]
    if not any(estimate for _, _, estimates in found for estimate in estimates):
        return None

    def draw(axes: Axes) -> None:
        shown = [row for row in found if any(row[2])]
        for number, (label, color, estimates) in enumerate(shown):
            offset = 0.12 * (number - (len(shown) - 1) / 2)
            first = True
            for place, estimate in enumerate(estimates):
                if estimate is not None:
                    low = 0.0 if math.isnan(estimate.low) else estimate.mean - estimate.low
                    high = 0.0 if math.isnan(estimate.high) else estimate.high - estimate.mean
                    axes.errorbar(
                        estimate.mean, place + offset, xerr=[[max(low, 0.0)], [max(high, 0.0)]], fmt="o", color=color,
                        markersize=4.5, capsize=2.5, label=label if first else None,
                    )  # fmt: skip
                    first = False
        for place, world in enumerate(WORLDS):
            if robot == TABLE3_ROBOT and world in paper.TABLE3:
                best, _ = paper.best_of_table3(world)
                known = "the paper's best" if place == 1 else None
                axes.plot(best, place, "|", color=PAPER, markersize=20, markeredgewidth=2, label=known)
        axes.axvline(0.97, color=PAPER, linewidth=0.8, linestyle=":")
        axes.set(yticks=range(len(WORLDS)), yticklabels=WORLDS, xlabel="reach rate, strict protocol", title=robot)
        axes.set_ylim(len(WORLDS) - 0.5, -0.5)
        axes.legend(loc="upper center", bbox_to_anchor=(0.4, -0.16), ncols=2)

    return _svg(f"reach-{robot}", draw, f"Reach rates of the {robot}", height=3.6)


def replanning(book: Book, world: str) -> str | None:
    """Steps to the goal against the steps between plans, of fixed periods and of the rule."""
    robots = [robot for robot in ROBOTS if book.group("replanning", f"period-{PERIODS[0]}", robot, world).done]
    if not robots:
        return None

    def draw(axes: Axes) -> None:
        for robot, color in zip(robots, (OURS, BASELINE, FINE_TUNED), strict=False):
            points = []
            for period in PERIODS:
                group = book.group("replanning", f"period-{period}", robot, world)
                points.append((group.estimate("steps_between_plans"), group.estimate("steps_mean")))
            known = [(x.mean, y.mean) for x, y in points if x is not None and y is not None]
            axes.plot([x for x, _ in known], [y for _, y in known], "o-", color=color, label=robot, markersize=4.5)
            rule = book.group("table3", "shipped", robot, world)
            x, y = rule.estimate("steps_between_plans"), rule.estimate("steps_mean")
            if x is not None and y is not None:
                axes.plot(x.mean, y.mean, "*", color=color, markersize=13, label=f"{robot}, the rule")
        axes.set(xscale="log", xlabel="steps between plans", ylabel="steps to the goal", ylim=(0, None), title=world)
        axes.set_xticks(PERIODS, [str(period) for period in PERIODS])
        axes.minorticks_off()
        axes.legend(fontsize=8)

    return _svg(f"replanning-{world}", draw, f"Replanning in {world}")


def _svg(name: str, draw: Callable[[Axes], None], title: str, height: float = 2.9) -> str:
    with matplotlib.rc_context({**_STYLE, "svg.hashsalt": name}):
        figure = Figure(figsize=(4.6, height), layout="constrained")
        FigureCanvasSVG(figure)
        figure.patch.set_alpha(0.0)
        axes = figure.add_subplot()
        axes.patch.set_alpha(0.0)
        draw(axes)
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' id="[A-Za-z0-9.]+_\d+"', "", text)  # not referred to, and the same in every figure
    text = re.sub(r'(<svg [^>]*?) width="[^"]+"', r"\1", text, count=1)
    text = re.sub(r'(<svg [^>]*?) height="[^"]+"', rf'\1 role="img" aria-label="{title}"', text, count=1)
    return text.replace(_INK, "currentColor")
