"""A bundle with small networks, made without torch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from hiernav.nav import bundle as b
from hiernav.nav.observation import ObservationLayout, ObservationTerm
from hiernav.runtime.policy import OnnxPlannerNetwork, OnnxSkill

LAYOUT = ObservationLayout((ObservationTerm("gyro", 3, "rad/s", 0.3), ObservationTerm("lidar", 2, "closeness", 1.0)))
ACTIONS, CHANNELS = 2, 3
ROBOT, ROBOT_SHA = "point", "a" * 64


def model_bytes(nodes: Sequence, inputs: Sequence, outputs: Sequence, weights: Sequence, opset: int = 18) -> bytes:
    graph = helper.make_graph(list(nodes), "net", list(inputs), list(outputs), list(weights))
    domains = {node.domain for node in nodes} - {""}
    opsets = [helper.make_opsetid("", opset), *(helper.make_opsetid(domain, 1) for domain in domains)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=10).SerializeToString()


def value(name: str, shape: Sequence, kind: int = TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def skill_bytes(seed: int = 0, opset: int = 18, **node_settings: object) -> bytes:
    """tanh(W x), 5 -> 2."""
    weight = np.random.default_rng(seed).standard_normal((LAYOUT.size, ACTIONS)).astype(np.float32)
    return model_bytes(
        [
            helper.make_node("MatMul", ["observation", "w"], ["h"]),
            helper.make_node("Tanh", ["h"], ["action"], **node_settings),
        ],
        [value("observation", ["N", LAYOUT.size])],
        [value("action", ["N", ACTIONS])],
        [numpy_helper.from_array(weight, "w")],
        opset,
    )


def planner_bytes(image_type: int = TensorProto.UINT8) -> bytes:
    """Mean of each channel times the distance, spread over 2 hypotheses of 10 waypoints."""
    weight = np.random.default_rng(1).standard_normal((CHANNELS, 2 * 10 * 2)).astype(np.float32)
    shape = numpy_helper.from_array(np.array([-1, 2, 10, 2], np.int64), "shape")
    column = numpy_helper.from_array(np.array([-1, 1], np.int64), "column")
    last = numpy_helper.from_array(np.array([2, 3], np.int64), "last")
    return model_bytes(
        [
            helper.make_node("Cast", ["image"], ["pixels"], to=TensorProto.FLOAT),
            helper.make_node("ReduceMean", ["pixels", "last"], ["means"], keepdims=0),
            helper.make_node("Reshape", ["distance", "column"], ["length"]),
            helper.make_node("Mul", ["means", "length"], ["scaled"]),
            helper.make_node("MatMul", ["scaled", "w"], ["flat"]),
            helper.make_node("Reshape", ["flat", "shape"], ["waypoints"]),
            helper.make_node("ReduceMean", ["waypoints", "last"], ["scores"], keepdims=0),
        ],
        [value("image", ["N", CHANNELS, 64, 64], image_type), value("distance", ["N"])],
        [value("waypoints", ["N", 2, 10, 2]), value("scores", ["N", 2])],
        [numpy_helper.from_array(weight, "w"), shape, column, last],
    )


def manifest(**changes: object) -> b.Manifest:
    fields: dict[str, object] = {
        "robot": ROBOT,
        "robot_sha256": ROBOT_SHA,
        "control_period_s": 0.02,
        "map_resolution_m": 0.05,
        "planner": b.PlannerSpec(
            inputs=(
                b.TensorSpec(name="image", shape=(None, CHANNELS, 64, 64), dtype="uint8"),
                b.TensorSpec(name="distance", shape=(None,), dtype="float32"),
            ),
            outputs=(
                b.TensorSpec(name="waypoints", shape=(None, 2, 10, 2), dtype="float32"),
                b.TensorSpec(name="scores", shape=(None, 2), dtype="float32"),
            ),
            preset="paper",
            channels=CHANNELS,
        ),
        "skill": b.SkillSpec(
            inputs=(b.TensorSpec(name="observation", shape=(None, LAYOUT.size), dtype="float32"),),
            outputs=(b.TensorSpec(name="action", shape=(None, ACTIONS), dtype="float32"),),
        ),
        "observation": tuple(
            b.ObservationField(name=t.name, size=t.size, unit=t.unit, scale=t.scale) for t in LAYOUT.terms
        ),
        "goselo": b.GoseloSpec(pixels=64, channels=("obstacles_1", "obstacles_2", "obstacles_4"), local_side_m=3.2),
        "plan": b.PlanSpec(waypoints=10, spacing_m=0.1, planning_radius_m=0.1, soft_margin_m=0.15),
        "replan": b.ReplanSpec(d_update_m=0.3, half_fraction=0.5, invalid=True),
        "provenance": {"steps": 1000, "rate": 3e-4, "world": "pillar(2,2,10)"},
    }
    return b.Manifest(**(fields | changes))


def write_bundle(folder: Path, **changes: object) -> b.Manifest:
    """Write a complete, valid bundle into `folder`."""
    rng = np.random.default_rng(2)
    skill, planner = skill_bytes(), planner_bytes()
    (folder / b.SKILL).write_bytes(skill)
    (folder / b.PLANNER).write_bytes(planner)
    observation = rng.standard_normal((4, LAYOUT.size)).astype(np.float32)
    image = rng.integers(0, 255, (3, CHANNELS, 64, 64), dtype=np.uint8)
    distance = rng.uniform(0.5, 3.0, 3).astype(np.float32)
    waypoints, scores = OnnxPlannerNetwork(planner)(image, distance)
    arrays = {"observation": observation, "action": OnnxSkill(skill)(observation), "image": image}
    b.write_golden(folder, arrays | {"distance": distance, "waypoints": waypoints, "scores": scores})
    return b.write_manifest(folder, manifest(**changes))
