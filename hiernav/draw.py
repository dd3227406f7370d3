"""Pictures of layouts and drives, for the eye and for print. Needs matplotlib (no display)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.lidar import PILLAR_RADIUS
from hiernav.sim.layout import GREMLIN_HALF_SIZE, GREMLIN_ORBIT, Layout, wall_boxes

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

OBSTACLE, EDGE, FLOOR = "#4a5568", "#2d3748", "#fbfaf7"
GREMLIN, START, GOAL = "#805ad5", "#1a202c", "#2f855a"
PATH, PLAN, COLLISION = "#2b6cb0", "#dd8a1f", "#e02424"
DRIVE_KEYS = ("path", "plans", "collisions", "title")
ARROW_LENGTH = 0.35  # [m], longer in fields of more than 7 m
DOTS_PER_INCH = 200
_LONG_SIDE_INCH = 6.0
_DASHES = (0, (4, 3))
_SCREEN_DOTS_PER_INCH = 100
_FIELD_MARGIN_PIXELS = 8.0


@dataclass(frozen=True)
class FieldPicture:
    """A layout's field seen from above, and where the world lies in it."""

    pixels: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    pixels_per_metre: float
    corner: tuple[float, float]
    """x, y of the upper left corner, world frame [m]."""

    def pixel_of(self, points: ArrayLike) -> NDArray[np.float64]:
        """World (..., 2) [m] -> column and row (..., 2) in pixels, whole numbers at the corners of pixels."""
        offset = np.asarray(points, dtype=np.float64) - self.corner
        return offset * (self.pixels_per_metre, -self.pixels_per_metre)


def field_picture(layout: Layout, long_side: int) -> FieldPicture:
    """What stands still in a layout, its start and its goal; the longer side of the picture has `long_side` pixels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    xmin, xmax, ymin, ymax = layout.extent
    scale = (long_side - 2.0 * _FIELD_MARGIN_PIXELS) / max(xmax - xmin, ymax - ymin)
    margin = _FIELD_MARGIN_PIXELS / scale
    width, height = (round(scale * side + 2.0 * _FIELD_MARGIN_PIXELS) for side in (xmax - xmin, ymax - ymin))
    figure = Figure(figsize=(width / _SCREEN_DOTS_PER_INCH, height / _SCREEN_DOTS_PER_INCH), dpi=_SCREEN_DOTS_PER_INCH)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.axis("off")
    _draw_field(axes, layout)
    _draw_task(axes, layout)
    left, top = xmin - margin, ymax + margin
    axes.set(xlim=(left, left + width / scale), ylim=(top - height / scale, top))
    canvas.draw()
    return FieldPicture(np.asarray(canvas.buffer_rgba())[..., :3].copy(), scale, (left, top))


def draw_layout(layout: Layout, path: str | Path, drive: Mapping[str, Any] | None = None) -> None:
    """Write a PNG of a layout at time 0, world frame, equal axes in metres, with a legend.

    drive: optionally what a robot did there; keys `path` (T, 2) driven, `plans` a list of (10, 2) waypoints,
        `collisions` (C, 2) points, `title` text; each may be absent.

    The folder is made if needed. Raises ValueError for another key in `drive` or an array of another shape, OSError if
    the file cannot be written.
    """
    # imported here: most who import hiernav never draw, and matplotlib takes long
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drive = dict(drive or {})
    unknown = sorted(set(drive) - set(DRIVE_KEYS))
    if unknown:
        raise ValueError(f"drive: unknown keys {unknown}, accepted are {list(DRIVE_KEYS)}")
    xmin, xmax, ymin, ymax = layout.extent
    scale = _LONG_SIDE_INCH / max(xmax - xmin, ymax - ymin)
    figure = Figure(figsize=(max(0.5, scale * (xmax - xmin)), max(0.5, scale * (ymax - ymin))))
    FigureCanvasAgg(figure)
    # the axes fill the figure; labels and legend lie outside and the tight box takes them in
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axisbelow(True)
    axes.grid(color="#e2e0da", linewidth=0.6)

    entries = _draw_field(axes, layout)
    entries |= _draw_gremlins(axes, layout)
    entries |= _draw_drive(axes, drive)
    entries |= _draw_task(axes, layout)

    axes.set(xlim=(xmin, xmax), ylim=(ymin, ymax), aspect="equal")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_facecolor("white")
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0, colors="#4a4a4a")
    axes.set_title(str(drive.get("title", f"{layout.spec}, seed {layout.seed}")), fontsize=11, loc="left", pad=8)
    axes.legend(
        list(entries.values()), list(entries), loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=9
    )
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DOTS_PER_INCH, format="png", bbox_inches="tight", pad_inches=0.15)


def _draw_field(axes: Axes, layout: Layout) -> dict[str, Artist]:
    from matplotlib.colors import ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Patch, Rectangle

    entries: dict[str, Artist] = {}
    xmin, xmax, ymin, ymax = layout.extent
    field = Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, facecolor=FLOOR, edgecolor="none", zorder=0.3)
    axes.add_patch(field)
    border = Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, edgecolor=EDGE, linewidth=1.6, zorder=6)
    border.set_clip_on(False)
    axes.add_patch(border)
    solid: dict[str, Any] = {"facecolor": OBSTACLE, "edgecolor": EDGE, "linewidth": 0.8}
    if layout.base_map is not None:
        occupied = np.ma.masked_equal(layout.base_map.occupied, False)
        axes.imshow(
            occupied,
            origin="lower",
            extent=layout.extent,
            cmap=ListedColormap([OBSTACLE]),
            interpolation="nearest",
            zorder=2,
        )
        entries["occupied"] = Patch(**solid)
    for x, y in layout.pillars:
        axes.add_patch(Circle((x, y), PILLAR_RADIUS, zorder=2, **solid))
    if len(layout.pillars):
        entries["pillar"] = _dot(OBSTACLE, EDGE)
    for center, half in zip(*wall_boxes(layout.walls), strict=True):
        axes.add_patch(Rectangle(center - half, *(2.0 * half), zorder=2, facecolor=OBSTACLE, edgecolor="none"))
    if len(layout.walls):
        entries["wall"] = Patch(facecolor=OBSTACLE)
    for center in layout.gremlins:
        axes.add_patch(Circle(center, GREMLIN_ORBIT, fill=False, edgecolor=GREMLIN, linewidth=0.9, linestyle=_DASHES))
    if len(layout.gremlins):
        entries["gremlins' circles, 1 rad/s"] = Line2D([], [], color=GREMLIN, linewidth=0.9, linestyle=_DASHES)
    return entries


def _draw_gremlins(axes: Axes, layout: Layout) -> dict[str, Artist]:
    from matplotlib.patches import Patch, Rectangle

    side = 2.0 * GREMLIN_HALF_SIZE
    for x, y in layout.gremlin_positions(0.0):
        corner = (x - GREMLIN_HALF_SIZE, y - GREMLIN_HALF_SIZE)
        axes.add_patch(Rectangle(corner, side, side, facecolor=GREMLIN, edgecolor=EDGE, linewidth=0.8, zorder=2))
    return {"gremlin (t = 0)": Patch(facecolor=GREMLIN, edgecolor=EDGE)} if len(layout.gremlins) else {}


def _draw_task(axes: Axes, layout: Layout) -> dict[str, Artist]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle

    x, y, yaw = layout.start.tolist()
    goal_x, goal_y = layout.goal.tolist()
    length = max(ARROW_LENGTH, 0.1 * max(layout.half_size))
    axes.annotate(
        "",
        xy=(x + length * np.cos(yaw), y + length * np.sin(yaw)),
        xytext=(x, y),
        arrowprops={
            "arrowstyle": "-|>,head_width=0.28,head_length=0.5",
            "color": START,
            "lw": 1.8,
            "shrinkA": 0,
            "shrinkB": 0,
        },
        zorder=5,
    )
    axes.plot(x, y, "o", color=START, markersize=7, markeredgecolor="white", markeredgewidth=1.0, zorder=5.1)
    axes.add_patch(Circle((goal_x, goal_y), GOAL_RADIUS, facecolor=GOAL, alpha=0.22, edgecolor="none", zorder=1.5))
    axes.add_patch(Circle((goal_x, goal_y), GOAL_RADIUS, fill=False, edgecolor=GOAL, linewidth=1.2, zorder=4))
    axes.plot(goal_x, goal_y, "*", color=GOAL, markersize=13, markeredgecolor="white", markeredgewidth=0.8, zorder=5)
    star = Line2D([], [], linestyle="none", marker="*", color=GOAL, markersize=12, markeredgecolor="white")
    return {"start and heading": _dot(START, "white"), f"goal, reached within {GOAL_RADIUS} m": star}


def _draw_drive(axes: Axes, drive: Mapping[str, Any]) -> dict[str, Artist]:
    from matplotlib.collections import LineCollection
    from matplotlib.lines import Line2D

    entries: dict[str, Artist] = {}
    driven = _points(drive.get("path"), "path")
    plans = [_points(plan, f"plans[{i}]") for i, plan in enumerate(drive.get("plans") or ())]
    collisions = _points(drive.get("collisions"), "collisions")
    if len(driven):
        axes.plot(*driven.T, color="white", linewidth=4.0, solid_capstyle="round", zorder=2.8)
        entries |= {"driven": axes.plot(*driven.T, color=PATH, linewidth=2.0, solid_capstyle="round", zorder=3)[0]}
    if plans:
        axes.add_collection(LineCollection(plans, colors=PLAN, linewidths=1.1, alpha=0.8, zorder=2.9))
        dots: dict[str, Any] = {"marker": "o", "markersize": 3.4, "markeredgecolor": "white", "markeredgewidth": 0.4}
        axes.plot(*np.concatenate(plans).T, linestyle="none", color=PLAN, zorder=3.2, **dots)
        entries[f"waypoints of {len(plans)} plans"] = Line2D([], [], color=PLAN, linewidth=1.1, **dots)
    if len(collisions):
        label = f"collision ({len(collisions)})"
        style: dict[str, Any] = {
            "linestyle": "none",
            "marker": "X",
            "color": COLLISION,
            "markersize": 9,
            "markeredgecolor": "white",
        }
        entries[label] = axes.plot(*collisions.T, zorder=5.5, **style)[0]
    return entries


def _points(value: Any, key: str) -> np.ndarray:
    if value is None:
        return np.zeros((0, 2))
    points = np.asarray(value, dtype=np.float64)
    if points.size == 0:
        return np.zeros((0, 2))
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"drive: {key} has shape {points.shape}, it must be (K, 2) [m]")
    return points


def _dot(color: str, edge: str) -> Artist:
    from matplotlib.lines import Line2D

    return Line2D([], [], linestyle="none", marker="o", color=color, markersize=8, markeredgecolor=edge)
