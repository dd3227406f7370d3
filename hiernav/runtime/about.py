"""What a recording says about the run it holds: enough to run the same policies again."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import msgspec

from hiernav import __version__
from hiernav.runtime.estimate import EstimatorConfig
from hiernav.runtime.guard import GuardConfig

PACKAGES = ("numpy", "onnxruntime", "mcap")


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What the metadata of a recording say of its run."""

    robot: str
    robot_radius: float
    """[m]"""
    goal_radius: float
    """[m]"""
    control_period: float
    """[s]"""
    bundle: str
    """Folder of the policies when the run was recorded."""
    hashes: dict[str, str]
    """SHA-256 of each file of the bundle."""
    planner_process: bool
    """Whether plans were made in a process of their own and came later than asked for."""
    estimator: EstimatorConfig
    guard: GuardConfig
    predict: bool = False
    """Whether plans were made on maps as they would be; recordings that do not say so are from before that."""
    world: str = ""
    started: str = msgspec.field(default_factory=lambda: time.strftime("%Y-%m-%dT%H:%M:%S%z"))
    versions: dict[str, str] = msgspec.field(default_factory=lambda: _versions())

    def metadata(self) -> dict[str, str]:
        """As texts: plain ones as they are, the others as JSON."""
        fields: dict[str, Any] = msgspec.to_builtins(self)
        return {k: v if isinstance(v, str) else msgspec.json.encode(v).decode() for k, v in fields.items()}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> About:
        """
        Raises:
            ValueError: an entry is missing or malformed.
        """
        texts = {f.encode_name for f in msgspec.structs.fields(cls) if f.type is str}
        try:
            values = {k: v if k in texts else msgspec.json.decode(v) for k, v in metadata.items()}
            return msgspec.convert(values, cls)
        except (msgspec.DecodeError, msgspec.ValidationError, RecursionError) as error:
            raise ValueError(f"what it says of its run is malformed: {error}") from None


def _versions() -> dict[str, str]:
    ours = {"hiernav": __version__, "python": platform.python_version()}
    return ours | {name: version(name) for name in PACKAGES}
