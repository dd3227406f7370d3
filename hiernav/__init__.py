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
    from hiernav.nav.agent import HierarchicalAgent
    from hiernav.nav.bundle import Bundle, BundleError, load_bundle
    from hiernav.nav.mapfile import load_map
    from hiernav.nav.observation import ObservationLayout
    from hiernav.nav.occupancy import OccupancyMap, VisitMap
    from hiernav.nav.option import Planner, PlanQuery, WaypointOption
    from hiernav.nav.planners import ShortestPathPlanner, VerifiedPlanner
    from hiernav.nav.search import PathField
    from hiernav.nav.termination import ReplanRule, TerminationReason
    from hiernav.runtime.policy import make_agent
    from hiernav.sim.batch import BatchSim
    from hiernav.sim.layout import parse_world
    from hiernav.sim.robots import get_robot
    from hiernav.sim.worlds import sample_layout

_HOME = {
    "ConfigError": "hiernav.config",
    "TrainConfig": "hiernav.config",
    "dump_config": "hiernav.config",
    "load_config": "hiernav.config",
    "Bundle": "hiernav.nav.bundle",
    "BundleError": "hiernav.nav.bundle",
    "load_bundle": "hiernav.nav.bundle",
    "load_map": "hiernav.nav.mapfile",
    "ObservationLayout": "hiernav.nav.observation",
    "OccupancyMap": "hiernav.nav.occupancy",
    "VisitMap": "hiernav.nav.occupancy",
    "HierarchicalAgent": "hiernav.nav.agent",
    "Planner": "hiernav.nav.option",
    "PlanQuery": "hiernav.nav.option",
    "ReplanRule": "hiernav.nav.termination",
    "TerminationReason": "hiernav.nav.termination",
    "WaypointOption": "hiernav.nav.option",
    "ShortestPathPlanner": "hiernav.nav.planners",
    "VerifiedPlanner": "hiernav.nav.planners",
    "PathField": "hiernav.nav.search",
    "make_agent": "hiernav.runtime.policy",
    "BatchSim": "hiernav.sim.batch",
    "get_robot": "hiernav.sim.robots",
    "parse_world": "hiernav.sim.layout",
    "sample_layout": "hiernav.sim.worlds",
}

__all__ = [
    "BatchSim",
    "Bundle",
    "BundleError",
    "ConfigError",
    "HierarchicalAgent",
    "ObservationLayout",
    "OccupancyMap",
    "PathField",
    "PlanQuery",
    "Planner",
    "ReplanRule",
    "ShortestPathPlanner",
    "TerminationReason",
    "TrainConfig",
    "VerifiedPlanner",
    "VisitMap",
    "WaypointOption",
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
