"""Runs the policies again on what a recording says they were given, and compares bit for bit.

Every tick's frame goes through the estimator again, its estimate and map through option, planner and skill, and what
the skill said through the guard. Each of them is given what was recorded, not what the one before it computed again:
what differs first is where a difference comes from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from hiernav.nav.bundle import Bundle
from hiernav.nav.occupancy import OccupancyMap
from hiernav.nav.option import Planner, PlanQuery, kept
from hiernav.nav.recovery import Recovery
from hiernav.runtime.about import About
from hiernav.runtime.estimate import Estimate
from hiernav.runtime.estimator import Estimator
from hiernav.runtime.guard import Guard
from hiernav.runtime.log_reader import LogError, RunLog
from hiernav.runtime.observe import Event, TickRecord
from hiernav.runtime.policy import load_networks, make_agent, make_planner
from hiernav.runtime.terms import TermHold

ASKED = 256
"""Questions to the planner that are kept until the answer to one of them comes."""


@dataclass(frozen=True)
class Difference:
    """The first value that came out otherwise."""

    run: int
    tick: int
    """As `TickRecord.index`, from the start of that run."""
    time: float
    """On the loop's clock [s]."""
    value: str
    """estimate, reason, plan, observation, proposed or sent."""
    recorded: str
    replayed: str

    def __str__(self) -> str:
        return (
            f"run {self.run}, tick {self.tick} ({self.time:.3f} s): {self.value} is {self.replayed}, "
            f"recorded was {self.recorded}"
        )


@dataclass
class Comparison:
    """How far recording and replay agree."""

    ticks: int = 0
    """Ticks read."""
    compared: dict[str, int] = field(default_factory=dict)
    """Values compared, by name."""
    difference: Difference | None = None
    complete: bool = False
    """Whether the recording is whole."""

    @property
    def equal(self) -> bool:
        return self.difference is None


class Replay:
    """The deciding part of a runtime, fed from a recording."""

    def __init__(self, log: RunLog, bundle: Bundle) -> None:
        """
        Args:
            log: what was recorded.
            bundle: verified policies; others than the recorded ones may be tried as well.

        Raises:
            LogError: the recording does not say enough of its run, or is of another robot.
            BundleError: the policies cannot be loaded.
        """
        self.log = log
        try:
            self.about = about = About.from_metadata(log.about)
        except ValueError as error:
            raise LogError(f"{log.path}: {error}") from None
        if about.robot != bundle.manifest.robot:
            raise LogError(f"{log.path}: a drive of {about.robot!r}, and a bundle for {bundle.manifest.robot!r}")
        self.same_policies = about.hashes == bundle.manifest.files
        network = load_networks(bundle).planner
        self._planner = make_planner(bundle, network, about.robot_radius, about.goal_radius)
        self._asked = _Asked() if about.planner_process else None
        self._agent = make_agent(bundle, about.robot_radius, about.goal_radius, self._asked, about.predict)
        self._agent.recovery = self._recovery = _Recorded(1, self._agent.control_period)
        self._estimator = Estimator(about.estimator)
        self._guard = Guard(bundle.golden["action"].shape[1], about.guard)
        self._begin()

    def compare(self, progress: Callable[[int], None] = lambda ticks: None) -> Comparison:
        """Go through the recording up to the first difference.

        Args:
            progress: called with the number of ticks so far, every hundred ticks.

        Raises:
            LogError: what was recorded cannot have happened.
        """
        result = Comparison()
        try:
            self._compare(result, progress)
        except LogError:
            raise
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise LogError(
                f"{self.log.path}: after {result.ticks} ticks, what cannot have happened: {error}"
            ) from error
        result.complete = self.log.complete
        return result

    def _compare(self, result: Comparison, progress: Callable[[int], None]) -> None:
        run = -1
        for item in self.log:
            if isinstance(item, Event):
                self._happened(item)
                continue
            if item.index == 0 or run < 0:
                run += 1
                self._begin()
            for name, recorded, replayed in self._values(item):
                result.compared[name] = result.compared.get(name, 0) + 1
                if not _same(recorded, replayed):
                    texts = _texts(recorded, replayed)
                    result.difference = Difference(run, item.index, item.time, name, *texts)
                    return
            result.ticks += 1
            if result.ticks % 100 == 0:
                progress(result.ticks)

    def _begin(self) -> None:
        """The loop was started: the estimator knows nothing."""
        sensors = self._agent.layout.sensors
        self._estimator.skill_sensors = sensors
        self._estimator.reset()
        self._terms = TermHold(sensors)

    def _happened(self, event: Event) -> None:
        if event.kind == "goal" and "x" in event.values:
            self._agent.reset()
            self._guard.reset()
        elif event.kind == "plan":
            self._agent.option.drop()

    def _values(self, tick: TickRecord) -> Iterator[tuple[str, object, object]]:
        """Name, recorded and replayed value of everything that was computed in a tick."""
        estimate = self._estimator.update(tick.frame)
        terms = self._terms.fill(tick.frame)
        yield "estimate", _state(tick.estimate), _state(estimate)
        if tick.observation is not None:
            yield from self._decision(tick, terms)
        if tick.sent is not None and tick.proposed is not None:
            yield "sent", tick.sent, self._guarded(tick, tick.proposed)
        elif tick.sent is None:
            self._guard.braked(None if tick.estimate is None else tick.estimate.upright)

    def _guarded(self, tick: TickRecord, proposed: np.ndarray) -> np.ndarray:
        estimate = tick.estimate
        if estimate is None:
            return self._guard.check(proposed, speed=tick.speed_scale).action
        velocity = estimate.body_velocity()
        return self._guard.check(proposed, estimate.upright, speed=tick.speed_scale, velocity=velocity).action

    def _decision(self, tick: TickRecord, terms: dict[str, np.ndarray]) -> Iterator[tuple[str, object, object]]:
        if tick.estimate is None or tick.goal is None or tick.occupancy is None:
            raise LogError(f"{self.log.path}: tick {tick.index} decided without estimate, goal or map")
        if self._asked is not None:
            self._asked.stamp = tick.estimate.stamp
            if tick.replanned:
                yield from self._answer(tick, self._asked)
        self._recovery.plan = tick.plan if tick.recovering else None
        pose, stamp = tick.estimate.pose[None], np.array([tick.estimate.stamp])
        step = self._agent.act(pose, terms, tick.goal[None], (tick.occupancy,), stamp)
        yield "reason", int(tick.reason), int(step.reason[0])
        yield "plan", tick.plan, step.plan[0]
        yield "observation", tick.observation, step.observation[0]
        yield "proposed", tick.proposed, step.action[0]

    def _answer(self, tick: TickRecord, asked: _Asked) -> Iterator[tuple[str, object, object]]:
        """A plan arrived that was asked for earlier: plan again from the state it was made from, then follow it."""
        query = asked.queries.get(tick.plan_stamp)
        if query is None or tick.plan is None or tick.plan_start is None:
            yield "plan", tick.plan, None
            return
        plan = np.asarray(self._planner.plan(query), dtype=np.float64)[0]
        if not tick.recovering:
            yield "plan", tick.plan, plan
            plan = tick.plan
        self._agent.option.adopt(0, plan, tick.plan_start, query.occupancy[0])


class _Recorded(Recovery):
    """In the place of the recovery, which hangs on more than was recorded: gives what it gave, where it gave it."""

    plan: np.ndarray | None = None

    def __call__(
        self, pose: np.ndarray, plan: np.ndarray, occupancy: Sequence[OccupancyMap], rows: np.ndarray | None = None
    ) -> np.ndarray:
        position, was = pose[:, :2], bool(self.active[0])
        self._forget(np.zeros(1, dtype=np.intp), position)
        active = self.plan is not None
        if active and not was:
            self._remember(0, position[0])
        self.active[0], self.ended[0], self._quiet = active, was and not active, not self._tries.any()
        return plan if self.plan is None else self.plan[None]


class _Asked(Planner):
    """In the place of a planner in its own process: keeps what it was asked."""

    def __init__(self) -> None:
        self.stamp = 0.0
        self.queries: dict[float | None, PlanQuery] = {}

    def plan(self, query: PlanQuery) -> None:  # type: ignore[override]
        self.queries.pop(self.stamp, None)  # a stamp comes again where no frame was new, or the clock started again
        self.queries[self.stamp] = kept(query)
        if len(self.queries) > ASKED:
            del self.queries[next(iter(self.queries))]


def _state(estimate: Estimate | None) -> object:
    if estimate is None:
        return None
    return np.concatenate(
        [estimate.pose, estimate.velocity, estimate.covariance.ravel(), [estimate.upright, estimate.yaw_rate]]
    )


def _differ(recorded: np.ndarray, replayed: np.ndarray) -> np.ndarray:
    """Where two arrays of one shape differ by a bit. What is no number is alike: a recording does not keep its bits."""
    recorded = recorded.astype(replayed.dtype)
    if not np.issubdtype(replayed.dtype, np.floating):
        return recorded != replayed
    alike = (recorded == replayed) & (np.signbit(recorded) == np.signbit(replayed))
    return ~(alike | (np.isnan(recorded) & np.isnan(replayed)))


def _same(recorded: object, replayed: object) -> bool:
    if isinstance(recorded, np.ndarray) and isinstance(replayed, np.ndarray):
        return recorded.shape == replayed.shape and not _differ(recorded, replayed).any()
    return type(recorded) is type(replayed) and recorded == replayed


def _texts(recorded: object, replayed: object) -> tuple[str, str]:
    """Both values; of arrays the first element that differs."""
    if isinstance(recorded, np.ndarray) and isinstance(replayed, np.ndarray) and recorded.shape == replayed.shape:
        ours, theirs = recorded.ravel(), replayed.ravel()
        k = int(np.flatnonzero(_differ(ours, theirs))[0])
        return f"{float(ours[k])!r} (element {k})", repr(float(theirs[k]))
    return str(recorded), str(replayed)
