from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hiernav.nav import bundle as b
from hiernav.runtime.policy import OnnxPlannerNetwork, OnnxSkill, check_golden, load_networks

onnx = pytest.importorskip("onnx", reason="needs the extra hiernav[train]")

from onnx import TensorProto, helper  # noqa: E402
from small_bundle import (  # noqa: E402
    CHANNELS,
    LAYOUT,
    model_bytes,
    planner_bytes,
    skill_bytes,
    value,
    write_bundle,
)

OBSERVATIONS = np.random.default_rng(0).standard_normal((7, LAYOUT.size)).astype(np.float32)


def test_one_row_and_many_rows_give_the_same_actions():
    skill = OnnxSkill(skill_bytes())
    together = skill(OBSERVATIONS)
    alone = np.concatenate([skill(row[None]) for row in OBSERVATIONS])
    np.testing.assert_allclose(alone, together, atol=1e-6)
    assert together.dtype == np.float32 and together.shape == (7, 2)
    assert (skill.observation_size, skill.action_dim) == (5, 2)


def test_an_action_is_not_overwritten_by_the_next_one():
    skill = OnnxSkill(skill_bytes())
    first = skill(OBSERVATIONS[:1])
    kept = first.copy()
    skill(OBSERVATIONS[1:2])
    np.testing.assert_array_equal(first, kept)


def test_float64_observations_are_accepted():
    skill = OnnxSkill(skill_bytes())
    for rows in (OBSERVATIONS[:1], OBSERVATIONS):
        np.testing.assert_allclose(skill(rows.astype(np.float64)), skill(rows), atol=1e-6)


@pytest.mark.parametrize("shape", [(5,), (1, 4), (2, 6), (1, 1, 5)])
def test_an_observation_of_another_size_is_refused(shape):
    with pytest.raises(ValueError, match="observations have shape"):
        OnnxSkill(skill_bytes())(np.zeros(shape, np.float32))


@pytest.mark.parametrize("image_type", [TensorProto.UINT8, TensorProto.FLOAT])
def test_images_are_handed_over_as_the_network_declares_them(image_type):
    network = OnnxPlannerNetwork(planner_bytes(image_type))
    image = np.random.default_rng(0).integers(0, 255, (4, CHANNELS, 64, 64), dtype=np.uint8)
    distance = np.linspace(0.5, 2.0, 4)
    waypoints, scores = network(image, distance)
    assert waypoints.shape == (4, 2, 10, 2) and scores.shape == (4, 2)
    again, _ = network(image.astype(np.float32), distance.astype(np.float32))
    np.testing.assert_array_equal(waypoints, again)


def test_a_skill_is_no_planner_and_a_planner_no_skill():
    with pytest.raises(b.BundleError, match="planner.onnx: .*expected image"):
        OnnxPlannerNetwork(skill_bytes())
    with pytest.raises(b.BundleError, match=r"skill.onnx: .*expected \(N, D\)"):
        OnnxSkill(planner_bytes())


def test_a_skill_of_unknown_size_is_refused():
    data = model_bytes([helper.make_node("Tanh", ["x"], ["y"])], [value("x", ["N", "D"])], [value("y", ["N", "D"])], [])
    with pytest.raises(b.BundleError, match="axis 1 of 'x' must have a fixed size"):
        OnnxSkill(data)


def test_what_onnx_runtime_cannot_load_is_refused_by_file():
    with pytest.raises(b.BundleError, match="skill.onnx: ONNX Runtime refuses it"):
        OnnxSkill(b"nonsense")


def test_a_whole_bundle_loads_and_keeps_its_golden_promises(tmp_path: Path):
    write_bundle(tmp_path)
    bundle = b.load_bundle(tmp_path)
    networks = load_networks(bundle)
    deviations = check_golden(bundle, networks)
    assert set(deviations) == {"action", "waypoints", "scores"}
    assert max(deviations.values()) <= 1e-5


def rewrite_golden(folder: Path, **changes: np.ndarray) -> b.Bundle:
    bundle = b.load_bundle(folder)
    b.write_golden(folder, dict(bundle.golden) | changes)
    b.write_manifest(folder, bundle.manifest)
    return b.load_bundle(folder)


@pytest.mark.parametrize("name", ["action", "waypoints", "scores"])
@pytest.mark.parametrize("error", [1e-3, np.nan])
def test_a_network_that_answers_differently_than_at_export_is_refused(tmp_path, name, error):
    write_bundle(tmp_path)
    value_ = b.load_bundle(tmp_path).golden[name].copy()
    value_.flat[-1] += error
    with pytest.raises(b.BundleError, match=f"golden {name}: off by"):
        load_networks(rewrite_golden(tmp_path, **{name: value_}))


def test_golden_inputs_of_another_shape_are_refused(tmp_path):
    write_bundle(tmp_path)
    with pytest.raises(b.BundleError, match="golden inputs do not fit"):
        load_networks(rewrite_golden(tmp_path, observation=np.zeros((4, 9), np.float32)))
    write_bundle(tmp_path)
    with pytest.raises(b.BundleError, match="golden scores: shape"):
        load_networks(rewrite_golden(tmp_path, scores=np.zeros((3, 5), np.float32)))


@pytest.mark.parametrize(
    ("part", "key", "field", "wrong", "message"),
    [
        ("skill", "inputs", "name", "obs", r"tensors \['observation'\], the manifest says \['obs'\]"),
        ("skill", "outputs", "shape", [None, 3], "'action' is"),
        ("planner", "inputs", "dtype", "float32", "'image' is"),
    ],
)
def test_a_manifest_that_describes_another_network_is_refused(tmp_path, part, key, field, wrong, message):
    write_bundle(tmp_path)
    path = tmp_path / b.MANIFEST
    fields = json.loads(path.read_text())
    fields[part][key][0][field] = wrong
    path.write_text(json.dumps(fields))
    with pytest.raises(b.BundleError, match=message):
        load_networks(b.load_bundle(tmp_path))


def test_an_observation_list_longer_than_the_networks_input_is_refused(tmp_path):
    longer = b.ObservationField(name="sonar", size=1, unit="m", scale=1.0)
    layout = tuple(
        b.ObservationField(name=term.name, size=term.size, unit=term.unit, scale=term.scale) for term in LAYOUT.terms
    )
    write_bundle(tmp_path, observation=(*layout, longer))
    with pytest.raises(b.BundleError, match="observation size: 5 in the network, 6 in the manifest"):
        load_networks(b.load_bundle(tmp_path))


def test_a_planner_that_answers_in_another_type_is_refused():
    model = onnx.load_from_string(planner_bytes())
    model.graph.node[-1].output[0] = "means_of_all"
    model.graph.node.append(helper.make_node("Cast", ["means_of_all"], ["scores"], to=TensorProto.STRING))
    model.graph.output[1].type.tensor_type.elem_type = TensorProto.STRING
    with pytest.raises(b.BundleError, match=r"planner.onnx: .*expected .*scores \(M, H\) float"):
        OnnxPlannerNetwork(model.SerializeToString())


@pytest.mark.parametrize(
    ("part", "field", "wrong", "message"),
    [
        ("goselo", "local_side_m", 7.0, r"goselo.local_side_m: 7 m in the bundle, 3.2 m in the runtime"),
        ("goselo", "margin_m", 0.5, r"goselo.margin_m: 0.5 m in the bundle, 0.4 m in the runtime"),
        ("goselo", "min_distance_m", 0.2, r"goselo.min_distance_m: 0.2 m in the bundle, 0.1 m in the runtime"),
        ("goselo", "clearance_clip_m", 0.6, r"goselo.clearance_clip_m: 0.6 m in the bundle, 0.64 m in the runtime"),
        ("goselo", "visit_clip", 5, r"goselo.visit_clip: 5 in the bundle, 4 in the runtime"),
        ("goselo", "pixels", 128, "goselo.pixels: 128 in the bundle, 64 in the runtime"),
        ("goselo", "channels", ["a"], "number of goselo.channels: 3 in the network, 1 in the manifest"),
        ("goselo", "channels", [], "number of goselo.channels: 3 in the network, 0 in the manifest"),
        ("goselo", "channels", ["obstacles_1", "a", "b"], "goselo.channels: GOSELO channel 'a': expected one of"),
        ("plan", "waypoints", 9, "plan.waypoints: 10 in the network, 9 in the manifest"),
        ("planner", "channels", 4, "planner channels: 3 in the network, 4 in the manifest"),
    ],
)
def test_a_manifest_that_the_runtime_would_not_keep_to_is_refused(tmp_path, part, field, wrong, message):
    write_bundle(tmp_path)
    path = tmp_path / b.MANIFEST
    fields = json.loads(path.read_text())
    fields[part][field] = wrong
    path.write_text(json.dumps(fields))
    with pytest.raises(b.BundleError, match=message):
        load_networks(b.load_bundle(tmp_path))


def test_a_skill_that_observes_another_number_of_waypoints_than_a_plan_has_is_refused(tmp_path):
    fields = (("waypoints", 4), ("gyro", 1))
    layout = tuple(b.ObservationField(name=name, size=size, unit="m", scale=1.0) for name, size in fields)
    write_bundle(tmp_path, observation=layout)
    with pytest.raises(b.BundleError, match="plan.waypoints: 10 in a plan, the skill observes 2"):
        load_networks(b.load_bundle(tmp_path))
