"""One film of a pair of policies in one world: the episodes that an evaluation of the same seed begins with."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hiernav.draw import field_picture
from hiernav.evaluate import Policies, episode_seeds, make_planner
from hiernav.film.caption import LEAST_WIDTH, caption
from hiernav.film.mujoco_view import MujocoView
from hiernav.film.top_view import TopView
from hiernav.film.writer import Writer, film_writer
from hiernav.nav.termination import TerminationReason
from hiernav.sim.factory import make_task
from hiernav.sim.layout import WorldSpec
from hiernav.sim.robots import get_robot
from hiernav.sim.rollout import Episode, run_episodes
from hiernav.sim.task import NavigationTask, TaskStep
from hiernav.sim.worlds import sample_layout

View = TopView | MujocoView
VIEWS = ("top", "mujoco")
_MOST_FRAMES_PER_SECOND = 25.0
_HOLD_SECONDS = 1.0


@dataclass(frozen=True)
class FilmSettings:
    """How a film is taken. Raises ValueError naming a value that is out of range."""

    view: str = "top"
    """"top", or "mujoco" for MuJoCo's own rendering beside it."""
    lidar: bool = False
    """Whether to draw what the lidar reads."""
    size: int = 480
    """Longer side of the field's picture [pixels]."""
    speed: float = 1.0
    """1 is the robot's own."""
    fps: float | None = None
    """Frames per second of the film; by default one for each control step, at most 25."""

    def __post_init__(self) -> None:
        if self.view not in VIEWS:
            raise ValueError(f"unknown view {self.view!r}; known: {', '.join(VIEWS)}")
        for name, least, most in (("size", 200, 2000), ("speed", 0.01, 100), ("fps", 1, 100)):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ValueError(f"{name} is {value:g}, it must be {least:g} to {most:g}")

    def frames_per_second(self, control_period: float) -> float:
        """Of the film of a robot with that control period [s]."""
        if self.fps is not None:
            return self.fps
        return min(_MOST_FRAMES_PER_SECOND, max(1.0, self.speed / control_period))


def make_film(
    policies: Policies,
    world: WorldSpec,
    path: Path,
    *,
    episodes: int = 3,
    seed: int = 0,
    planner: str = "cnn",
    settings: FilmSettings | None = None,
    on_frame: Callable[[int], None] | None = None,
    on_episode: Callable[[int, Episode], None] | None = None,
) -> list[Episode]:
    """Drive episodes and film them; returns what became of them.

    Args:
        path: of the film, ending in .mp4 or .gif.
        episodes: how many, one after the other.
        planner: see `hiernav.evaluate.make_planner`.
        on_frame: called with the number of frames so far.
        on_episode: called with the number of an episode, from 0, and the episode when it has ended.

    Raises:
        ValueError: the film cannot be encoded, or there is nothing to render with.
    """
    if episodes < 1:
        raise ValueError(f"episodes must be at least 1, got {episodes}")
    settings = settings or FilmSettings()
    robot = get_robot(policies.config.robot)
    layouts = [sample_layout(world, int(s), robot.radius) for s in episode_seeds(seed, episodes)]
    task = make_task(policies.config, 1, make_planner(policies, planner), [world])
    with ExitStack() as stack:
        top = TopView(task, settings.size, settings.lidar)
        views: list[View] = [top]
        if settings.view == "mujoco":
            height, width = field_picture(layouts[0], settings.size).pixels.shape[:2]
            views.append(stack.enter_context(closing(MujocoView(task, width, height))))
        writer = stack.enter_context(film_writer(path, settings.frames_per_second(robot.control_period)))
        guide = "no planner" if policies.is_baseline else f"{planner} planner"
        camera = _Camera(task, top, views, writer, settings, f"{guide}, episode {{}} of {episodes}", on_frame)

        def end(number: int, episode: Episode) -> None:
            camera.end(episode)
            if on_episode is not None:
                on_episode(number, episode)

        return run_episodes(task, policies.skill, layouts, end, camera.step)


def film_name(world: WorldSpec) -> str:
    """A world's name without what is awkward in names of files: "pillar-2-2-10", "map-hall"."""
    text = str(world) if world.map_path is None else f"map-{Path(world.map_path).stem}"
    return re.sub(r"[^A-Za-z0-9.]+", "-", text).strip("-")


def film_names(worlds: Sequence[WorldSpec]) -> dict[WorldSpec, str]:
    """Names of the films of several worlds, no two alike: maps of one name in different folders get numbers."""
    names: dict[WorldSpec, str] = {}
    for world in worlds:
        name, number = film_name(world), 1
        while name in names.values():
            number += 1
            name = f"{film_name(world)}-{number}"
        names[world] = name
    return names


class _Camera:
    """Turns the control steps of a task with one row into the frames of a film."""

    def __init__(
        self,
        task: NavigationTask,
        top: TopView,
        views: Sequence[View],
        writer: Writer,
        settings: FilmSettings,
        subtitle: str,
        on_frame: Callable[[int], None] | None,
    ) -> None:
        self._task, self._top, self._views, self._writer = task, top, views, writer
        self._subtitle, self._on_frame = subtitle, on_frame
        rate = settings.frames_per_second(task.robot.control_period)
        self._frames_per_step = rate * task.robot.control_period / settings.speed
        self._hold = max(1, round(_HOLD_SECONDS * rate))
        self._episodes, self._frames = 0, 0
        self._due = 0.0
        self._collisions = 0
        self._last: TaskStep | None = None

    def step(self, step: TaskStep) -> None:
        """Write the frames that are due."""
        if self._last is None:
            self._top.begin()
            self._collisions, self._due = 0, 1.0 - self._frames_per_step  # one frame of the first step
        self._last = step
        self._top.follow(step)
        self._collisions += int(step.collided[0])
        self._due += self._frames_per_step
        # more by a trifle, for many fractions of a frame that add up to a whole one
        times = int(self._due + 1e-6)
        if times:
            self._due -= times
            self._write(step, times)

    def end(self, episode: Episode) -> None:
        """Write how the episode ended, for a second."""
        assert self._last is not None, "an episode has at least one step"
        self._write(self._last, self._hold, episode)
        self._episodes, self._last = self._episodes + 1, None

    def _write(self, step: TaskStep, times: int, episode: Episode | None = None) -> None:
        picture = np.concatenate([view.frame(step) for view in self._views], axis=1)
        height, width = picture.shape[:2]
        width = max(width, LEAST_WIDTH)
        text = caption(width, self._title(), self._now(), self._replans(), episode)
        # video encoders want even sides
        frame = np.full((_even(height + len(text)), _even(width), 3), 255, dtype=np.uint8)
        frame[:height, : picture.shape[1]] = picture
        frame[height : height + len(text), :width] = text
        self._writer.write(frame, times)
        self._frames += times
        if self._on_frame is not None:
            self._on_frame(self._frames)

    def _title(self) -> str:
        layout = self._task.layouts[0]
        return f"{layout.spec}, seed {layout.seed}, {self._subtitle.format(self._episodes + 1)}"

    def _now(self) -> str:
        steps, layout = int(self._task.steps[0]), self._task.layouts[0]
        seconds = steps * self._task.robot.control_period
        return f"step {steps} of {layout.spec.max_steps}, {seconds:.1f} s, {self._collisions} with contact"

    def _replans(self) -> dict[str, int]:
        counts = self._task.option.counts[0]
        return {reason.name.lower(): int(counts[reason]) for reason in TerminationReason}


def _even(length: int) -> int:
    return length + length % 2
