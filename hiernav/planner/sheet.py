"""A contact sheet: what the waypoint generator is shown and taught, for the eye. Needs matplotlib (no display)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hiernav.nav import goselo
from hiernav.planner.dataset import LabelSettings, Samples

_SAMPLES, _COLUMNS = 24, 6
_CELL_INCH = 1.25
_PATH, _ROBOT, _GOAL, _VISITS = "#dd6b20", "#2b6cb0", "#2f855a", (0.17, 0.42, 0.69)


def draw_sheet(samples: Samples, settings: LabelSettings, path: str | Path) -> None:
    """Write a PNG of 24 random samples with their labels.

    Every sample has two pictures, the goal above the robot in both: the crop of side 2 L with obstacles and visits,
    and the clearance around the robot at its metric size (3.2 m).
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    chosen = np.random.default_rng(0).permutation(len(samples))[:_SAMPLES]
    columns = min(_COLUMNS, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(2 * columns * _CELL_INCH, rows * (_CELL_INCH + 0.2)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 2 * columns, squeeze=False).reshape(rows * columns, 2)
    for pair in axes.flat:
        pair.axis("off")
    for (wide, near), sample in zip(axes, chosen.tolist(), strict=False):
        length, label = float(samples.distance[sample]), samples.label[sample]
        wide.imshow(_overview(samples.image[sample], settings))
        _draw_plan(wide, label, length, 2.0 * length, 0.5 * length)
        near.imshow(samples.clearance[sample], cmap="bone", vmin=0, vmax=255)
        _draw_plan(near, label, length, goselo.LOCAL_SIDE, 0.0)
        wide.set_title(f"L = {length:.2f} m", fontsize=6, pad=2)
    figure.savefig(path, dpi=150, format="png")


def _overview(image: np.ndarray, settings: LabelSettings) -> np.ndarray:
    """(64, 64, 3) RGB: obstacles dark, visits blue where the network is shown them."""
    free = 1.0 - image[settings.channels.index("obstacles_2")] / 255.0 * 0.75
    rgb = np.repeat(free[..., None], 3, axis=-1)
    if "visits_2" in settings.channels:
        seen = np.minimum(image[settings.channels.index("visits_2")] / 64.0, 1.0)[..., None]
        rgb = (1.0 - seen) * rgb + seen * np.array(_VISITS)
    return rgb


def _draw_plan(axes, label: np.ndarray, length: float, side: float, below: float) -> None:  # type: ignore[no-untyped-def]
    """A plan (K, 2) on a crop of `side` [m] whose centre lies `below` metres above the robot."""
    points = np.concatenate([np.zeros((1, 2)), label, [[0.0, length]]]) - [0.0, below]
    x, y = (points * [1.0, -1.0] / side + 0.5).T * goselo.PIXELS - 0.5
    axes.plot(x[:-1], y[:-1], color=_PATH, linewidth=0.8, marker=".", markersize=1.5)
    axes.plot(x[0], y[0], color=_ROBOT, marker="o", markersize=3)
    if abs(points[-1, 1]) <= side / 2:
        axes.plot(x[-1], y[-1], color=_GOAL, marker="*", markersize=5)
    axes.set(xlim=(-0.5, goselo.PIXELS - 0.5), ylim=(goselo.PIXELS - 0.5, -0.5))
