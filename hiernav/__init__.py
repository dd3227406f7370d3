"""Hierarchical navigation: a learned waypoint planner over a learned locomotion skill.

The public names are imported when they are first used. Importing `hiernav` itself loads nothing but this file, and
where Gymnasium is installed (never on a robot) registers the environments with it.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from hiernav.config import ConfigError, TrainConfig, dump_config, load_config
    from hiernav.nav.agent import AgentStep, HierarchicalAgent
    from hiernav.nav.bundle import Bundle, BundleError, load_bundle
    from hiernav.nav.mapfile import MapFileError, load_map
    from hiernav.nav.observation import ObservationLayout
    from hiernav.nav.occupancy import OccupancyMap, VisitMap
    from hiernav.nav.option import Planner, PlanQuery, WaypointOption
    from hiernav.nav.planners import ShortestPathPlanner, VerifiedPlanner
    from hiernav.nav.search import PathField
    from hiernav.nav.termination import ReplanRule, TerminationReason
    from hiernav.runtime.policy import make_agent
    from hiernav.sim.batch import BatchSim
    from hiernav.sim.layout import Layout, WorldSpec, parse_world
    from hiernav.sim.robots import RobotSpec, get_robot
    from hiernav.sim.scene import SceneSpec
    from hiernav.sim.worlds import sample_layout

_NAMES = {
    "hiernav.config": ("ConfigError", "TrainConfig", "dump_config", "load_config"),
    "hiernav.nav.agent": ("AgentStep", "HierarchicalAgent"),
    "hiernav.nav.bundle": ("Bundle", "BundleError", "load_bundle"),
    "hiernav.nav.mapfile": ("MapFileError", "load_map"),
    "hiernav.nav.observation": ("ObservationLayout",),
    "hiernav.nav.occupancy": ("OccupancyMap", "VisitMap"),
    "hiernav.nav.option": ("Planner", "PlanQuery", "WaypointOption"),
    "hiernav.nav.planners": ("ShortestPathPlanner", "VerifiedPlanner"),
    "hiernav.nav.search": ("PathField",),
    "hiernav.nav.termination": ("ReplanRule", "TerminationReason"),
    "hiernav.runtime.policy": ("make_agent",),
    "hiernav.sim.batch": ("BatchSim",),
    "hiernav.sim.layout": ("Layout", "WorldSpec", "parse_world"),
    "hiernav.sim.robots": ("RobotSpec", "get_robot"),
    "hiernav.sim.scene": ("SceneSpec",),
    "hiernav.sim.worlds": ("sample_layout",),
}
_HOME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = [
    "AgentStep",
    "BatchSim",
    "Bundle",
    "BundleError",
    "ConfigError",
    "HierarchicalAgent",
    "Layout",
    "MapFileError",
    "ObservationLayout",
    "OccupancyMap",
    "PathField",
    "PlanQuery",
    "Planner",
    "ReplanRule",
    "RobotSpec",
    "SceneSpec",
    "ShortestPathPlanner",
    "TerminationReason",
    "TrainConfig",
    "VerifiedPlanner",
    "VisitMap",
    "WaypointOption",
    "WorldSpec",
    "__version__",
    "dump_config",
    "get_robot",
    "load_bundle",
    "load_config",
    "load_map",
    "make_agent",
    "parse_world",
    "sample_layout",
]


if not TYPE_CHECKING:  # a checker, which has the imports above, is to find a name that is misspelt

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'hiernav' has no attribute {name!r}")
        value = getattr(import_module(_HOME[name]), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)


if find_spec("gymnasium") is not None:
    import_module("hiernav.envs")
