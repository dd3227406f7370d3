"""Result files, `RESULTS/<experiment>/<cell>.json`: small, checked when read, and telling where they come from."""

from __future__ import annotations

import math
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from hiernav import __version__
from hiernav.files import write_atomically
from hiernav.sim.batch import processors

_PACKAGES = ("numpy", "mujoco", "onnxruntime", "torch", "torchrl")


class ResultError(ValueError):
    """A result file that cannot be used; the message names it."""


class Machine(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a result was made."""

    cpu: str
    cores: int
    """That the process may use."""
    system: str
    versions: dict[str, str]
    gpu: str | None = None
    """That torch found in the process that did the work; in results of older versions that the system has."""


class Result(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What became of a cell."""

    format: Literal[1] = 1
    experiment: str
    cell: str
    state: Literal["done", "failed"]
    key: str
    """`cell_key` when it was made."""
    robot: str
    variant: str
    seed: int | None
    world: str | None
    command: str
    settings: dict[str, Any]
    """What was measured, and of a training each setting that differs from the defaults."""
    source: dict[str, Any]
    """The policies: bundle and hashes, or run folder, and the commits of the processes that trained in it."""
    commit: str | None
    """When the cell started."""
    dirty: bool | None
    """Whether tracked files differed from the commit, or code that was loaded before did."""
    started: str
    seconds: float
    """What it took; of a training that was stopped and went on, all of it."""
    machine: Machine
    metrics: dict[str, Any] = {}
    curves: dict[str, list[dict[str, float | None]]] = {}
    error: str | None = None

    @property
    def id(self) -> str:
        return f"{self.experiment}/{self.cell}"


class Drive(msgspec.Struct, frozen=True, kw_only=True):
    """What a drive through a world's episodes came to, as far as it is needed again."""

    episodes: int
    reach_rate: float
    reach_ci95: tuple[float, float]
    steps_mean: float
    steps_half95: float | None
    """Half the width of the 95 % interval, as in the other names that end so."""
    collisions_mean: float
    collisions_half95: float | None
    collision_free_rate: float
    spl_mean: float | None
    spl_half95: float | None
    return_mean: float | None
    """None where the reward is not known; in results of older versions by the default one then, from a bundle."""
    steps_between_plans: float | None
    endings: dict[str, int]
    """How often episodes ended by each of "goal", "left_field", "timeout", "fallen", "physics" (`Episode.reason`)."""
    proposals: int = 0
    repairs: int = 0


def drive_of(result: Result, protocol: str = "strict") -> Drive | None:
    """What a result says under a protocol, None if it was not driven.

    Raises:
        ResultError: numbers are missing, or are none.
    """
    if protocol not in result.metrics:
        return None
    try:
        return msgspec.convert(result.metrics[protocol], Drive)
    except msgspec.ValidationError as error:
        raise ResultError(f"result {result.id}: metrics.{protocol}: {error}") from None


class Walks(msgspec.Struct, frozen=True):
    """What an entry of Table II holds at least."""

    samples: int
    collisions_mean: float


class PlanWalk(msgspec.Struct, frozen=True):
    """What is shown of walks along the plans of one planner; proposals and repairs where they are verified."""

    collisions_mean: float
    reach_rate: float
    proposals: int = 0
    repairs: int = 0


class PlanWalks(msgspec.Struct, frozen=True):
    """The same walks along the plans of three."""

    network: PlanWalk
    verified: PlanWalk
    astar: PlanWalk


class Film(msgspec.Struct, frozen=True):
    """What a film's result holds."""

    file: Annotated[str, msgspec.Meta(pattern=r"^[^/]+$")]
    """In the folder of the results of films."""
    bytes: int
    reached: int
    """Episodes in which the robot reaches its goal."""


def result_path(folder: Path, cell: str) -> Path:
    """File of a cell ("experiment/name")."""
    return folder / f"{cell}.json"


def write_result(folder: Path, result: Result) -> Path:
    """Write a result so that it is there as a whole or not at all. Numbers that are not finite become null."""
    path = result_path(folder, result.id)
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = msgspec.json.encode(_finite(msgspec.to_builtins(result)))
    write_atomically(path, msgspec.json.format(encoded, indent=1) + b"\n")
    return path


def read_result(folder: Path, cell: str) -> Result | None:
    """The result of a cell ("experiment/name"), or None if there is none.

    Raises:
        ResultError: the file is damaged, of another format, or lies in the wrong place.
    """
    path = result_path(folder, cell)
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ResultError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        result = msgspec.json.decode(text, type=Result)
    except (msgspec.DecodeError, msgspec.ValidationError, UnicodeDecodeError, RecursionError) as error:
        raise ResultError(f"{path}: not a result of this version: {error}") from None
    if result.id != cell:
        raise ResultError(f"{path}: holds the result of {result.id}")
    if (result.state == "failed") != (result.error is not None):
        raise ResultError(f"{path}: state {result.state!r} with error {result.error!r}")
    if result.state == "done":
        try:
            _check_contents(result)
        except (ResultError, msgspec.ValidationError) as error:
            raise ResultError(f"{path}: {error}") from None
    return result


def read_results(folder: Path) -> tuple[list[Result], list[str]]:
    """Every result in a folder, and a line for each file that cannot be used."""
    results, damaged = [], []
    for path in sorted(folder.glob("*/*.json")):
        try:
            result = read_result(folder, f"{path.parent.name}/{path.stem}")
        except ResultError as error:
            damaged.append(str(error))
        else:
            if result is not None:
                results.append(result)
    return results, damaged


def _check_contents(result: Result) -> None:
    """Raise if what the experiment is about is missing."""
    if result.experiment == "table2":
        msgspec.convert(result.metrics, Walks)
    elif result.experiment == "walks":
        msgspec.convert(result.metrics, PlanWalks)
    elif result.experiment == "films":
        msgspec.convert(result.metrics, Film)
    elif result.experiment != "planners" and drive_of(result) is None:
        raise ResultError(f"result {result.id}: no metrics.strict")
    drive_of(result, "paper")
    if any(point.get("step") is None for points in result.curves.values() for point in points):
        raise ResultError(f"result {result.id}: a point of a curve has no step")


def this_machine() -> Machine:
    """What results of this process are made on; which GPU, if any, is for whoever computes on it to say."""
    versions = {"hiernav": __version__, "python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            pass
    system = f"{platform.system()} {platform.machine()}"
    return Machine(cpu=_cpu(), cores=processors(), system=system, versions=versions)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
