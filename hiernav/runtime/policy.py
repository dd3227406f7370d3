"""The two networks in ONNX Runtime (one thread, no spinning, verified bytes), and the agent made of them."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

# Before ONNX Runtime is imported: since 1.29 it would keep a database on disk, and upload from threads of its own.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
import onnxruntime as ort

from hiernav.nav import goselo
from hiernav.nav.agent import HierarchicalAgent
from hiernav.nav.bundle import PLANNER, SKILL, Bundle, BundleError, GoseloSpec, PlanSpec, TensorSpec
from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.observation import WAYPOINT_GUIDES
from hiernav.nav.option import DeferredPlanner, Planner, WaypointOption, refresh_steps
from hiernav.nav.planners import ShortestPathPlanner, verified_planner
from hiernav.runtime.robot import Robot

GOLDEN_TOLERANCE = 1e-5
_DTYPES: dict[str, np.dtype[Any]] = {"tensor(float)": np.dtype(np.float32), "tensor(uint8)": np.dtype(np.uint8)}


class OnnxSkill:
    """Observations (N, D) float32 -> actions (N, A) float32 in [-1, 1].

    A single row goes through buffers that are bound once. Not to be called from two threads at a time.
    """

    def __init__(self, model: bytes) -> None:
        """
        Raises:
            BundleError: `model` is not a network with one 2-D float input and one 2-D float output.
        """
        self._session = _session(model, SKILL)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        tensors = [*inputs, *outputs]
        if [len(each.shape) for each in tensors] != [2, 2] or {each.type for each in tensors} != {"tensor(float)"}:
            raise BundleError(f"{SKILL}: {_signature(self._session)}; expected (N, D) float -> (N, A) float")
        self.observation_size = _known(inputs[0], 1, SKILL)
        self.action_dim = _known(outputs[0], 1, SKILL)
        self._input, self._output = inputs[0].name, outputs[0].name
        self._row = np.zeros((1, self.observation_size), np.float32)
        self._action = np.zeros((1, self.action_dim), np.float32)
        self._binding = self._session.io_binding()
        self._binding.bind_input(self._input, "cpu", 0, np.float32, self._row.shape, self._row.ctypes.data)
        self._binding.bind_output(self._output, "cpu", 0, np.float32, self._action.shape, self._action.ctypes.data)

    def __call__(self, observations: np.ndarray) -> np.ndarray:
        """A new array each time; ValueError for observations of another size."""
        if observations.ndim != 2 or observations.shape[1] != self.observation_size:
            raise ValueError(
                f"skill: observations have shape {observations.shape}, expected (N, {self.observation_size})"
            )
        if len(observations) == 1:
            self._row[:] = observations
            self._session.run_with_iobinding(self._binding)
            return self._action.copy()
        rows = np.ascontiguousarray(observations, dtype=np.float32)
        return self._session.run([self._output], {self._input: rows})[0]


class OnnxPlannerNetwork:
    """GOSELO images (M, C, 64, 64) and distances (M,) [m] -> waypoints (M, H, K, 2) [m] and scores (M, H).

    Waypoints are in the GOSELO frame. Images of any number type are handed over as the network declares them.
    """

    def __init__(self, model: bytes) -> None:
        """
        Raises:
            BundleError: `model` is not a network of that signature.
        """
        self._session = _session(model, PLANNER)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        ranks = [len(each.shape) for each in (*inputs, *outputs)]
        others = {each.type for each in (*inputs[1:], *outputs)}
        if ranks != [4, 1, 4, 2] or inputs[0].type not in _DTYPES or others != {"tensor(float)"}:
            raise BundleError(
                f"{PLANNER}: {_signature(self._session)}; expected image (M, C, 64, 64) float or uint8 and "
                "distance (M) float -> waypoints (M, H, K, 2) float, scores (M, H) float"
            )
        self.channels = _known(inputs[0], 1, PLANNER)
        self.waypoints = _known(outputs[0], 2, PLANNER)
        pixels = (_known(inputs[0], 2, PLANNER), _known(inputs[0], 3, PLANNER))
        if pixels != (goselo.PIXELS, goselo.PIXELS) or _known(outputs[0], 3, PLANNER) != 2:
            raise BundleError(f"{PLANNER}: {_signature(self._session)}; expected 64 by 64 pixels and waypoints (K, 2)")
        self._image_dtype = _DTYPES[inputs[0].type]
        self._inputs = [each.name for each in inputs]
        self._outputs = [each.name for each in outputs]

    def __call__(self, image: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        feed = {
            self._inputs[0]: np.ascontiguousarray(image, dtype=self._image_dtype),
            self._inputs[1]: np.ascontiguousarray(distance, dtype=np.float32),
        }
        waypoints, scores = self._session.run(self._outputs, feed)
        return waypoints, scores


@dataclass(frozen=True)
class Networks:
    """Both networks of a bundle."""

    skill: OnnxSkill
    planner: OnnxPlannerNetwork


def load_networks(bundle: Bundle) -> Networks:
    """Load both networks, check them against the manifest and on the golden inputs, and the manifest against what is
    done here with both.

    Raises:
        BundleError: a network does not load, has other inputs or outputs than the manifest says, or gives other values
            than it did when it was exported; images or plans are not made here as the manifest says.
    """
    networks = Networks(OnnxSkill(bundle.skill), OnnxPlannerNetwork(bundle.planner))
    manifest = bundle.manifest
    _require_tensors(networks.skill._session, manifest.skill.inputs, manifest.skill.outputs, SKILL)
    _require_tensors(networks.planner._session, manifest.planner.inputs, manifest.planner.outputs, PLANNER)
    for what, ours, theirs in (
        ("observation size", networks.skill.observation_size, bundle.layout.size),
        ("planner channels", networks.planner.channels, manifest.planner.channels),
        ("plan.waypoints", networks.planner.waypoints, manifest.plan.waypoints),
        ("number of goselo.channels", networks.planner.channels, len(manifest.goselo.channels)),
    ):
        if ours != theirs:
            raise BundleError(f"{what}: {ours} in the network, {theirs} in the manifest")
    _require_images(manifest.goselo)
    _require_waypoints(bundle)
    check_golden(bundle, networks)
    return networks


def _require_images(spec: GoseloSpec) -> None:
    """BundleError unless the planner is shown the images that it was trained on."""
    for name, ours in goselo.constants().items():
        theirs = getattr(spec, name)
        if not abs(theirs - ours) <= 1e-9:
            unit = " m" if name.endswith("_m") else ""
            raise BundleError(f"goselo.{name}: {theirs:g}{unit} in the bundle, {ours:g}{unit} in the runtime")
    try:
        goselo.check_channels(spec.channels)
    except ValueError as error:
        raise BundleError(f"goselo.channels: {error}") from None


def _require_waypoints(bundle: Bundle) -> None:
    """BundleError unless the skill observes as many waypoints as a plan has; a baseline observes none."""
    count = bundle.manifest.plan.waypoints
    for term in bundle.layout.terms:
        if term.name in WAYPOINT_GUIDES and term.size != 2 * count:
            raise BundleError(f"plan.waypoints: {count} in a plan, the skill observes {term.size / 2:g}")


def require_fit(bundle: Bundle, robot: Robot) -> None:
    """Raise BundleError unless the bundle is for a robot of this rate, with as many actuators."""
    bundle.require_period(robot.control_period)
    bundle.require_actions(robot.action_dim)


class PlannerSettings(msgspec.Struct, frozen=True):
    """All that makes a planner of a network, also where that runs in another process."""

    plan: PlanSpec
    channels: tuple[str, ...]
    """Of the network's images."""
    robot_radius: float
    """Disc with which plans are swept against the map [m]."""
    goal_radius: float
    """Distance at which the goal counts as reached [m]."""

    def planner_of(self, network: OnnxPlannerNetwork) -> Planner:
        """The network on GOSELO images, verified, and repaired by shortest paths."""
        plan = self.plan
        expert = ShortestPathPlanner(
            plan.planning_radius_m, plan.soft_margin_m, num_waypoints=plan.waypoints, spacing=plan.spacing_m
        )
        return verified_planner(network, self.channels, expert, self.robot_radius, self.goal_radius)


def planner_settings(bundle: Bundle, robot_radius: float, goal_radius: float = GOAL_RADIUS) -> PlannerSettings:
    """Those of the planner that a bundle describes."""
    manifest = bundle.manifest
    return PlannerSettings(manifest.plan, tuple(manifest.goselo.channels), robot_radius, goal_radius)


def make_planner(
    bundle: Bundle, network: OnnxPlannerNetwork, robot_radius: float, goal_radius: float = GOAL_RADIUS
) -> Planner:
    """The planner a bundle describes: the network on GOSELO images, verified, and repaired by shortest paths.

    Args:
        bundle: verified policies.
        network: of that bundle.
        robot_radius: disc with which plans are swept against the map [m].
        goal_radius: distance at which the goal counts as reached [m].
    """
    return planner_settings(bundle, robot_radius, goal_radius).planner_of(network)


def make_agent(
    bundle: Bundle,
    robot_radius: float,
    goal_radius: float = GOAL_RADIUS,
    planner: Planner | DeferredPlanner | None = None,
    predict: bool = True,
    rows: int = 1,
) -> HierarchicalAgent:
    """The agent a bundle describes: planner with verification, termination rule, skill.

    Args:
        bundle: verified policies.
        robot_radius: disc with which plans are swept against the map [m].
        goal_radius: distance at which the goal counts as reached [m].
        planner: in the place of the bundle's own, such as one in a process of its own. Its plans are followed as they
            are: `VerifiedPlanner` sweeps and repairs them.
        predict: see `WaypointOption`.
        rows: robots that are driven at once.

    Raises:
        BundleError: as `load_networks`.
    """
    networks, plan = load_networks(bundle), bundle.manifest.plan
    option = WaypointOption(
        planner or make_planner(bundle, networks.planner, robot_radius, goal_radius),
        num_rows=rows,
        rule=bundle.manifest.replan.rule(),
        num_waypoints=plan.waypoints,
        goal_radius=goal_radius,
        sweep_radius=robot_radius,
        refresh=refresh_steps(bundle.manifest.control_period_s),
        predict=predict,
    )
    return HierarchicalAgent(option, networks.skill, bundle.layout, bundle.manifest.control_period_s)


def check_golden(bundle: Bundle, networks: Networks | None = None) -> dict[str, float]:
    """Run the golden inputs.

    Returns:
        Largest deviation of each output, absolute below 1 and relative above.

    Raises:
        BundleError: an output deviates by more than 1e-5 or is not finite; names it.
    """
    networks = networks or Networks(OnnxSkill(bundle.skill), OnnxPlannerNetwork(bundle.planner))
    golden = bundle.golden
    try:
        waypoints, scores = networks.planner(golden["image"], golden["distance"])
        # Row by row: that is the way the robot calls it.
        action = np.concatenate([networks.skill(row[None]) for row in golden["observation"]])
    except Exception as error:  # ONNX Runtime raises classes of its own, without a common base but this
        raise BundleError(f"golden inputs do not fit the networks: {error}") from None
    deviations = {}
    for name, value in (("action", action), ("waypoints", waypoints), ("scores", scores)):
        expected = golden[name]
        if value.shape != expected.shape:
            raise BundleError(f"golden {name}: shape {value.shape}, expected {expected.shape}")
        deviation = float(np.max(np.abs(value - expected) / np.maximum(1.0, np.abs(expected)), initial=0.0))
        if not deviation <= GOLDEN_TOLERANCE:
            raise BundleError(f"golden {name}: off by {deviation:.2g}, the limit is {GOLDEN_TOLERANCE:g}")
        deviations[name] = deviation
    return deviations


def _session(model: bytes, name: str) -> ort.InferenceSession:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 3
    try:
        return ort.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # as above
        raise BundleError(f"{name}: ONNX Runtime refuses it: {str(error).splitlines()[0]}") from None


def _known(tensor: ort.NodeArg, axis: int, name: str) -> int:
    size = tensor.shape[axis]
    if not isinstance(size, int) or size < 1:
        raise BundleError(f"{name}: axis {axis} of {tensor.name!r} must have a fixed size, it has {size!r}")
    return size


def _signature(session: ort.InferenceSession) -> str:
    def text(tensors: list[ort.NodeArg]) -> str:
        return ", ".join(f"{tensor.name} {tensor.shape} {tensor.type}" for tensor in tensors)

    return f"{text(session.get_inputs())} -> {text(session.get_outputs())}"


def _require_tensors(
    session: ort.InferenceSession, inputs: tuple[TensorSpec, ...], outputs: tuple[TensorSpec, ...], name: str
) -> None:
    for declared, actual in ((inputs, session.get_inputs()), (outputs, session.get_outputs())):
        if [spec.name for spec in declared] != [tensor.name for tensor in actual]:
            raise BundleError(
                f"{name}: tensors {[tensor.name for tensor in actual]}, the manifest says "
                f"{[spec.name for spec in declared]}"
            )
        for spec, tensor in zip(declared, actual, strict=True):
            shape = tuple(size if isinstance(size, int) else None for size in tensor.shape)
            dtype = str(_DTYPES.get(tensor.type, tensor.type))
            if (spec.shape, spec.dtype) != (shape, dtype):
                raise BundleError(
                    f"{name}: {tensor.name!r} is {shape} {dtype}, the manifest says {spec.shape} {spec.dtype}"
                )
