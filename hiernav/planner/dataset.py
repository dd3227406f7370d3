"""Labelled samples for the waypoint generator (paper section IV-A).

One shortest-path field per world labels every start in it. Half of the starts lie anywhere in the field, close to
obstacles too; the other half lie on the way from such a start to the goal, with the visits made so far. The start
itself is among the visits of both, as a robot has entered the pixel it stands in before it plans.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np

from hiernav.config import TrainConfig
from hiernav.nav import goselo
from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.nav.search import PathField, random_shortcuts, resample
from hiernav.orphans import end_with_parent
from hiernav.planner.mix import WorldMix
from hiernav.run import WorkersLost
from hiernav.sim.layout import WorldSpec
from hiernav.sim.robots import get_robot
from hiernav.sim.worlds import WorldError, sample_layout

T = TypeVar("T")

_CLEARANCE = "clearance_local"
_WORLDS_PER_TASK = 8
_MIN_CLEARANCE = 0.03
"""Starts keep at least this far from obstacles [m]: a robot in contact is about there."""
_MAX_TRIES = 200
"""Starts tried for each sample of a world, on average."""
_OFF_PATH = 0.1
"""Standard deviation of starts around the path [m]."""

_wanted: Connection | None = None
"""In a process that makes samples for another one: readable once they are not wanted any more."""


@dataclass(frozen=True)
class LabelSettings:
    """How labels are made."""

    worlds: tuple[str, ...]
    """Entries of a `WorldMix`."""
    radius: float
    """Disc that labels keep free [m]."""
    soft_margin: float
    """Further clearance worth a detour [m]."""
    waypoints: int = 10
    spacing: float = 0.1
    samples_per_world: int = 100
    random_smoothing: bool = False
    """The paper's random shortcuts instead of the longest straight lines."""
    channels: tuple[str, ...] = goselo.METRIC_CHANNELS
    """What the network is shown."""

    @property
    def image_channels(self) -> tuple[str, ...]:
        """Channels of a sample's image: the network's, and the clearance for the loss if it is not the last of them."""
        return self.channels if self.channels[-1] == _CLEARANCE else (*self.channels, _CLEARANCE)


@dataclass
class Samples:
    """Network inputs and labels in the GOSELO frame."""

    image: np.ndarray
    """(S, C, 64, 64) uint8, `LabelSettings.image_channels`."""
    distance: np.ndarray
    """(S,) float32, L [m]."""
    label: np.ndarray
    """(S, K, 2) float32, right and up of the robot [m]."""

    @classmethod
    def empty(cls, settings: LabelSettings, count: int) -> Samples:
        """Room for `count` samples."""
        return cls(
            np.empty((count, len(settings.image_channels), goselo.PIXELS, goselo.PIXELS), dtype=np.uint8),
            np.empty(count, dtype=np.float32),
            np.empty((count, settings.waypoints, 2), dtype=np.float32),
        )

    @classmethod
    def join(cls, parts: Sequence[Samples]) -> Samples:
        """Several sets as one."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))

    def store(self, first: int, part: Samples) -> int:
        """Copy `part`, or as much of it as there is room for, to the rows from `first` on; how many that were."""
        keep = min(len(part), len(self) - first)
        for name in self.__dataclass_fields__:
            getattr(self, name)[first : first + keep] = getattr(part, name)[:keep]
        return keep

    @property
    def clearance(self) -> np.ndarray:
        """(S, 64, 64) uint8, `clearance_local` crop for the penalty on waypoints near obstacles."""
        return self.image[:, -1]

    def __len__(self) -> int:
        return len(self.label)


def label_settings(config: TrainConfig) -> LabelSettings:
    """How a configuration's samples are labelled."""
    planner, option = config.planner, config.option
    paper = planner.preset == "paper"
    return LabelSettings(
        worlds=planner.worlds,
        radius=planner.planning_radius_m or get_robot(config.robot).radius,
        soft_margin=planner.soft_margin_m,
        waypoints=option.waypoints,
        spacing=option.spacing_m,
        samples_per_world=planner.samples_per_world,
        random_smoothing=paper,
        channels=goselo.CHANNELS if paper else goselo.METRIC_CHANNELS,
    )


def data_seed(config: TrainConfig) -> tuple[int, ...]:
    """What the samples of a configuration are drawn from."""
    return config.seed, 4


def make_samples(
    settings: LabelSettings,
    count: int,
    seed: Sequence[int],
    processes: int = 1,
    on_progress: Callable[[int], None] | None = None,
) -> Samples:
    """Draw worlds and label starts in them; the result depends on the seed alone, not on `processes`.

    Raises:
        WorkersLost: see `map_tasks`.
    """
    worlds = -(-count // settings.samples_per_world)
    tasks = [
        (settings, tuple(seed), first, min(_WORLDS_PER_TASK, worlds - first))
        for first in range(0, worlds, _WORLDS_PER_TASK)
    ]
    samples, done = Samples.empty(settings, count), 0
    for part in map_tasks(label_worlds, tasks, processes):
        done += samples.store(done, part)
        if on_progress is not None:
            on_progress(done)
    return samples


def map_tasks(function: Callable[..., T], tasks: Sequence[tuple[Any, ...]], processes: int) -> Iterator[T]:
    """Results of `function(*task)` in the order of the tasks, computed here or in several processes.

    Once nobody wants more of them, as after Ctrl-C, the samples that are under way are given up.

    Raises:
        WorkersLost: one of these died.
    """
    if processes == 1 or len(tasks) == 1:
        for task in tasks:
            yield function(*task)
        return
    context = get_context("forkserver")
    wanted, want = context.Pipe(duplex=False)
    try:
        with wanted, ProcessPoolExecutor(processes, context, _begin_work, (wanted,)) as pool, want:
            yield from pool.map(function, *zip(*tasks, strict=True))
    except BrokenProcessPool as error:
        raise WorkersLost(
            f"one of {processes} processes that make samples died, as it happens where memory runs out: "
            "begin again with fewer threads"
        ) from error


def _begin_work(wanted: Connection) -> None:
    """In a worker: make samples until the other end of `wanted` is closed; Ctrl-C is for the parent alone."""
    global _wanted
    _wanted = wanted
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


def _require_wanted() -> None:
    """InterruptedError if whoever asked for samples does not want them any more."""
    if _wanted is not None and _wanted.poll():
        raise InterruptedError("nobody wants these samples any more")


def label_world(settings: LabelSettings, spec: WorldSpec, seed: int, count: int) -> Samples:
    """`count` samples of one world; WorldError if a path leads to the goal from hardly anywhere."""
    _require_wanted()
    rng = np.random.default_rng(np.random.SeedSequence((seed, 0x1ABE1)))
    layout = sample_layout(spec, seed, settings.radius)
    occupancy = layout.occupancy(0.0)
    field = PathField(occupancy, layout.goal, settings.radius, settings.soft_margin)
    starts: list[np.ndarray] = []
    labels: list[np.ndarray] = []
    visits: list[VisitMap] = []
    tries = 0
    while len(starts) < count:
        _require_wanted()
        tries += 1
        if tries > _MAX_TRIES * count:
            raise WorldError(
                f"world {spec}, seed {seed}: {len(starts)} of {tries - 1} starts have a path to the goal "
                f"{layout.goal.round(2).tolist()} for a disc of {settings.radius:g} m; use a map with more room, or a "
                "smaller planner.planning_radius_m"
            )
        start, seen = _random_start(occupancy, rng), VisitMap(occupancy)
        if len(starts) % 2:
            path = field.waypoints(start, 80, 0.05)
            if path is None:
                continue
            # not among the copies of the goal that the path is padded with
            reached = rng.integers(1 + np.count_nonzero((path[:-1] != path[-1]).any(axis=1)))
            start = path[reached] + rng.normal(0.0, _OFF_PATH, 2)
            if not occupancy.clearance_at(start) > _MIN_CLEARANCE:
                continue
            seen.add(path[: reached + 1])
        label = _label(field, start, settings, rng)
        if label is None:
            continue
        seen.add(start)
        starts.append(start)
        labels.append(label)
        visits.append(seen)
    frame = goselo.GoseloFrame.of(np.array(starts), np.broadcast_to(layout.goal, (count, 2)))
    image = goselo.images([occupancy] * count, visits, frame, settings.image_channels)
    label = frame.from_world(np.array(labels)).astype(np.float32)
    return Samples(image, frame.distance.astype(np.float32), label)


def _label(field: PathField, start: np.ndarray, settings: LabelSettings, rng: np.random.Generator) -> np.ndarray | None:
    if not settings.random_smoothing:
        return field.waypoints(start, settings.waypoints, settings.spacing)
    path = field.path_from(start)
    if path is None:
        return None
    return resample(random_shortcuts(path, field, rng), settings.waypoints, settings.spacing)


def _random_start(occupancy: OccupancyMap, rng: np.random.Generator) -> np.ndarray:
    xmin, xmax, ymin, ymax = occupancy.extent
    while True:
        points = rng.uniform((xmin, ymin), (xmax, ymax), (16, 2))
        free = np.flatnonzero(occupancy.clearance_at(points) > _MIN_CLEARANCE)
        if len(free):
            return points[free[0]]


def label_worlds(settings: LabelSettings, seed: tuple[int, ...], first: int, worlds: int) -> Samples:
    """The samples of some consecutive worlds of a seed's endless sequence."""
    mix, parts = WorldMix(settings.worlds), []
    for number in range(first, first + worlds):
        sequence = np.random.SeedSequence(seed, spawn_key=(number,))
        world_seed = int(sequence.generate_state(1)[0])
        spec = mix.draw(np.random.default_rng(sequence.spawn(1)[0]))
        parts.append(label_world(settings, spec, world_seed, settings.samples_per_world))
    return Samples.join(parts)
