from __future__ import annotations

import io
import json
import pickle
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiernav.nav import bundle as b
from hiernav.nav.observation import ObservationLayout, ObservationTerm
from hiernav.nav.onnx_file import OnnxFileError, inspect_onnx

onnx = pytest.importorskip("onnx", reason="needs the extra hiernav[train]")

from onnx import TensorProto, helper  # noqa: E402
from small_bundle import (  # noqa: E402
    LAYOUT,
    ROBOT,
    ROBOT_SHA,
    manifest,
    model_bytes,
    planner_bytes,
    skill_bytes,
    value,
    write_bundle,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_bundle(tmp_path)
    return tmp_path


def edit_manifest(folder: Path, **changes: object) -> None:
    path = folder / b.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def replace_file(folder: Path, name: str, data: bytes) -> None:
    """Exchange a file and have the manifest's hash follow, as somebody with intent would."""
    (folder / name).write_bytes(data)
    files = json.loads((folder / b.MANIFEST).read_text())["files"]
    edit_manifest(folder, files=files | {name: b.file_sha256(folder / name)})


def test_what_was_written_is_what_is_loaded(folder):
    loaded = b.load_bundle(folder)
    assert loaded.skill == (folder / b.SKILL).read_bytes()
    assert loaded.planner == (folder / b.PLANNER).read_bytes()
    assert loaded.manifest.opset == 18
    assert loaded.manifest.provenance["rate"] == 3e-4
    assert loaded.layout == LAYOUT
    assert set(loaded.golden) == set(b.GOLDEN_NAMES)


@pytest.mark.parametrize("name", [*b.HASHED_FILES, b.MANIFEST])
def test_a_missing_file_is_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(b.BundleError, match=f"{name}: missing"):
        b.load_bundle(folder)


shares = st.floats(0, 1, exclude_max=True)


@settings(max_examples=30)
@given(name=st.sampled_from(b.HASHED_FILES), at=shares, flip=st.integers(1, 255))
def test_one_changed_byte_is_noticed_wherever_it_is(tmp_path_factory, name, at, flip):
    folder = tmp_path_factory.mktemp("bundle")
    write_bundle(folder)
    data = bytearray((folder / name).read_bytes())
    data[int(at * len(data))] ^= flip
    (folder / name).write_bytes(data)
    with pytest.raises(b.BundleError, match=f"{name}: SHA-256"):
        b.load_bundle(folder)


@pytest.mark.parametrize("name", b.HASHED_FILES)
def test_a_truncated_file_is_noticed(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(b.BundleError, match=f"{name}: SHA-256"):
        b.load_bundle(folder)


def test_no_folder_no_bundle(tmp_path):
    with pytest.raises(b.BundleError, match="no such folder"):
        b.load_bundle(tmp_path / "nothing")


def test_a_newer_format_asks_for_an_upgrade_even_with_fields_unknown_here(folder):
    edit_manifest(folder, format_version=2, novelty={"x": 1})
    with pytest.raises(b.BundleError, match="made by a newer hiernav.*upgrade"):
        b.load_bundle(folder)


GOSELO = {"pixels": 64, "channels": ["obstacles_1", "obstacles_2", "obstacles_4"], "local_side_m": 3.2}
PLAN = {"waypoints": 10, "spacing_m": 0.1, "planning_radius_m": 0.1, "soft_margin_m": 0.15}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 0}, "format_version 0"),
        ({"surprise": 1}, "surprise"),
        ({"control_period_s": 0.0}, "control_period_s"),
        ({"control_period_s": "fast"}, "control_period_s"),
        ({"control_period_s": 1e-300}, "control_period_s"),
        ({"control_period_s": 1e300}, "control_period_s"),
        ({"map_resolution_m": 1e300}, "map_resolution_m"),
        ({"goselo": GOSELO | {"pixels": 10**9}}, "pixels"),
        ({"goselo": GOSELO | {"local_side_m": 1e300}}, "local_side_m"),
        ({"plan": PLAN | {"waypoints": 10**9}}, "waypoints"),
        ({"plan": PLAN | {"spacing_m": 1e-300}}, "spacing_m"),
        ({"plan": PLAN | {"planning_radius_m": 1e300}}, "planning_radius_m"),
        ({"plan": PLAN | {"soft_margin_m": 1e300}}, "soft_margin_m"),
        ({"observation": [{"name": "gyro", "size": 10**9, "unit": "rad/s", "scale": 1.0}]}, "size"),
        ({"robot_sha256": "xyz"}, "robot_sha256"),
        ({"provenance": {"nested": {}}}, "provenance"),
    ],
)
def test_a_malformed_manifest_is_refused_by_field(folder, changes, message):
    edit_manifest(folder, **changes)
    with pytest.raises(b.BundleError, match=message):
        b.load_bundle(folder)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"\xff\xfe", b'{"format_version": 1}'])
def test_a_manifest_that_is_none_is_refused(folder, data):
    (folder / b.MANIFEST).write_bytes(data)
    with pytest.raises(b.BundleError, match=b.MANIFEST):
        b.load_bundle(folder)


@pytest.mark.parametrize("name", ["../skill.onnx", "/etc/passwd", "skill.onnx/../x", "extra.onnx", "manifest.json"])
def test_only_the_known_file_names_are_accepted(folder, name):
    files = json.loads((folder / b.MANIFEST).read_text())["files"]
    edit_manifest(folder, files=files | {name: "0" * 64})
    with pytest.raises(b.BundleError, match="files lists"):
        b.load_bundle(folder)


def test_the_wrong_robot_is_named(folder):
    bundle = b.load_bundle(folder)
    bundle.require_robot(ROBOT, ROBOT_SHA)
    with pytest.raises(b.BundleError, match="for 'point', this is 'car'"):
        bundle.require_robot("car", ROBOT_SHA)
    with pytest.raises(b.BundleError, match="robot_sha256"):
        bundle.require_robot(ROBOT, "b" * 64)


GYRO, LIDAR = LAYOUT.terms


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ((LIDAR, GYRO), r"observation\[0\] 'gyro': name is 'gyro' in the bundle, 'lidar' on this robot"),
        ((GYRO, replace(LIDAR, size=3)), r"observation\[1\] 'lidar': size is 2 in the bundle, 3 on this robot"),
        ((replace(GYRO, unit="deg/s"), LIDAR), r"observation\[0\] 'gyro': unit is 'rad/s'"),
        ((GYRO, replace(LIDAR, scale=2.0)), r"observation\[1\] 'lidar': scale is 1.0"),
        ((GYRO,), r"observation\[1\] 'lidar': it exists only in the bundle"),
        ((GYRO, LIDAR, ObservationTerm("sonar", 1, "m", 1.0)), r"observation\[2\] 'sonar': .* only on this robot"),
    ],
)
def test_the_first_differing_field_of_the_observation_is_named(folder, terms, message):
    bundle = b.load_bundle(folder)
    bundle.require_layout(LAYOUT)
    with pytest.raises(b.BundleError, match=message):
        bundle.require_layout(ObservationLayout(terms))


def with_external_weights() -> bytes:
    model = onnx.load_from_string(skill_bytes())
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="../../secret.bin")
    return model.SerializeToString()


def test_weights_in_another_file_are_refused(folder):
    replace_file(folder, b.SKILL, with_external_weights())
    with pytest.raises(b.BundleError, match="skill.onnx: weights in external files"):
        b.load_bundle(folder)


def test_external_weights_are_found_inside_of_branches():
    inner = onnx.load_from_string(with_external_weights()).graph
    inner.ClearField("input")
    branch = helper.make_node("If", ["c"], ["y"], then_branch=inner, else_branch=inner)
    data = model_bytes([branch], [value("c", [1], TensorProto.BOOL)], [value("y", ["N", 2])], [])
    assert inspect_onnx(data).external_data


def test_external_weights_are_found_in_the_defaults_of_a_function_s_attributes():
    model = onnx.load_from_string(skill_bytes())
    function = model.functions.add(name="f", domain="")
    inner = onnx.load_from_string(with_external_weights()).graph.initializer[0]
    function.attribute_proto.append(helper.make_attribute("weight", inner))
    assert inspect_onnx(model.SerializeToString()).external_data


@pytest.mark.parametrize("part", ["values", "indices"])
def test_external_weights_are_found_in_sparse_ones(part):
    model = onnx.load_from_string(skill_bytes())
    weight = onnx.load_from_string(with_external_weights()).graph.initializer[0]
    getattr(model.graph.sparse_initializer.add(), part).CopyFrom(weight)
    assert inspect_onnx(model.SerializeToString()).external_data


def test_a_model_that_is_to_be_trained_is_refused(folder):
    model = onnx.load_from_string(skill_bytes())
    model.training_info.add().algorithm.name = "sgd"
    replace_file(folder, b.SKILL, model.SerializeToString())
    with pytest.raises(b.BundleError, match="skill.onnx: .*training_info"):
        b.load_bundle(folder)


@pytest.mark.parametrize("domain", ["com.microsoft", "evil", "ai.onnx.ml"])
def test_operators_outside_of_the_standard_are_refused(folder, domain):
    replace_file(folder, b.SKILL, skill_bytes(domain=domain))
    with pytest.raises(b.BundleError, match=f"custom operators are not accepted: {domain}.Tanh"):
        b.load_bundle(folder)


def test_a_model_over_50_megabytes_is_refused_before_it_is_read_whole(folder):
    with (folder / b.SKILL).open("r+b") as file:
        file.truncate(b.MAX_FILE_BYTES + 1)
    with pytest.raises(b.BundleError, match="skill.onnx: larger than 50 MB"):
        b.load_bundle(folder)


def test_a_model_of_another_opset_than_promised_is_refused(folder):
    replace_file(folder, b.SKILL, skill_bytes(opset=17))
    with pytest.raises(b.BundleError, match="skill.onnx: opset 17, the manifest says 18"):
        b.load_bundle(folder)


def test_something_that_is_no_model_is_refused(folder):
    replace_file(folder, b.PLANNER, b"MZ this is a program")
    with pytest.raises(b.BundleError, match="planner.onnx: not an ONNX model"):
        b.load_bundle(folder)


def test_pickled_golden_arrays_are_refused_and_not_executed(folder, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "exploded",))

    buffer = io.BytesIO()
    arrays = dict(b.load_bundle(folder).golden) | {"action": np.array([Bomb()], dtype=object)}
    np.savez(buffer, **arrays)
    replace_file(folder, b.GOLDEN, buffer.getvalue())
    with pytest.raises(b.BundleError, match="golden.npz"):
        b.load_bundle(folder)
    replace_file(folder, b.GOLDEN, pickle.dumps(Bomb()))
    with pytest.raises(b.BundleError, match="golden.npz"):
        b.load_bundle(folder)
    assert not (tmp_path / "exploded").exists()


def test_a_golden_file_that_inflates_without_end_is_refused(folder):
    buffer = io.BytesIO()
    np.savez_compressed(buffer, observation=np.zeros(b.MAX_FILE_BYTES, np.uint8))
    replace_file(folder, b.GOLDEN, buffer.getvalue())
    with pytest.raises(b.BundleError, match="golden.npz: inflates"):
        b.load_bundle(folder)


def test_a_golden_file_without_all_its_arrays_is_refused(folder):
    buffer = io.BytesIO()
    np.savez(buffer, observation=np.zeros(3))
    replace_file(folder, b.GOLDEN, buffer.getvalue())
    with pytest.raises(b.BundleError, match="it must hold"):
        b.load_bundle(folder)
    with pytest.raises(ValueError, match="golden arrays are"):
        b.write_golden(folder, {"observation": np.zeros(3)})


def npy(header: str, body: bytes = b"", version: int = 1) -> bytes:
    text = (header + "\n").encode("latin1")
    return b"\x93NUMPY" + bytes([version, 0]) + len(text).to_bytes(2 if version == 1 else 4, "little") + text + body


def header(shape: str, kind: str = "<f4") -> str:
    return f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}"


def array_bytes(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def golden_zip(folder: Path, method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> bytes:
    """The golden file of a bundle, with some of its members replaced."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, array in b.load_bundle(folder).golden.items():
            archive.writestr(f"{name}.npy", members.get(name, array_bytes(array)))
    return buffer.getvalue()


def zip_field(data: bytes, offset: int, value: int) -> bytes:
    """Set two bytes of every header of an archive, local and central; `offset` is that in a local one."""
    changed = bytearray(data)
    for signature, shift in ((b"PK\x03\x04", 0), (b"PK\x01\x02", 2)):
        at = data.find(signature)
        while at >= 0:
            changed[at + shift + offset : at + shift + offset + 2] = value.to_bytes(2, "little")
            at = data.find(signature, at + 1)
    return bytes(changed)


@pytest.mark.parametrize(
    ("action", "reason"),
    [
        (npy(header("(100000000000, 2)")), r"action has shape \(100000000000, 2\), which 0 bytes do not fill"),
        (npy(header(f"({10**30}, 2)")), "do not fill"),
        (npy(header("(4, 2)"), bytes(31)), "which 31 bytes do not fill"),
        (npy(header("(4, 2)"), bytes(33)), "which 33 bytes do not fill"),
        (npy(header("(-4, -2)"), bytes(32)), "expected 2 axes, none of them empty"),
        (npy(header("(0, 2)")), "expected 2 axes, none of them empty"),
        (npy(header("(4, 2)"), bytes(32), version=3), r"npy version \(3, 0\)"),
        (npy("(" * 4), "damaged"),
        (npy("(" * 9000), "damaged"),
        (npy("\0"), "damaged"),
        (npy(header("(4, 2)", "nonsense")), "damaged"),
        (b"MZ this is no array", "damaged"),
        (b"", "damaged"),
        (array_bytes(np.float32(1)), "expected 2 axes"),
        (array_bytes(np.zeros(4, np.float32)), "expected 2 axes"),
        (array_bytes(np.zeros((4, 2), "U3")), "action is <U3, expected float32"),
        (array_bytes(np.zeros((4, 2), np.complex64)), "action is complex64, expected float32"),
        (array_bytes(np.zeros((4, 2))), "action is float64, expected float32"),
        (array_bytes(np.zeros((4, 2), ">f4")), "action is >f4, expected float32"),
        (array_bytes(np.zeros((3, 2), np.float32)), "observation, action have 4, 3 rows, expected as many"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_golden_arrays_are_of_the_type_the_rank_and_the_size_they_say(folder, action, reason):
    replace_file(folder, b.GOLDEN, golden_zip(folder, action=action))
    tracemalloc.start()
    with pytest.raises(b.BundleError, match=f"golden.npz: .*{reason}") as error:
        b.load_bundle(folder)
    assert tracemalloc.get_traced_memory()[1] < 2 * b.MAX_FILE_BYTES
    tracemalloc.stop()
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_golden_arrays_stored_by_columns_are_read_as_they_were(folder):
    before = b.load_bundle(folder).golden
    b.write_golden(folder, {name: np.asfortranarray(array) for name, array in before.items()})
    replace_file(folder, b.GOLDEN, (folder / b.GOLDEN).read_bytes())
    for name, array in b.load_bundle(folder).golden.items():
        np.testing.assert_array_equal(array, before[name])


METHOD, FLAGS = 8, 6
"""Offsets in a zip archive's headers."""


@pytest.mark.parametrize(
    ("offset", "value", "reason"),
    [
        (METHOD, 1, "compressed by method 1"),
        (METHOD, 12, "compressed by method 12"),
        (METHOD, 14, "compressed by method 14"),
        (METHOD, 93, "compressed by method 93"),
        (METHOD, 99, "compressed by method 99"),
        (FLAGS, 1, "damaged .*encrypted"),
    ],
)
def test_a_golden_file_that_is_packed_in_another_way_is_refused(folder, offset, value, reason):
    replace_file(folder, b.GOLDEN, zip_field(golden_zip(folder), offset, value))
    with pytest.raises(b.BundleError, match=f"golden.npz: .*{reason}"):
        b.load_bundle(folder)


def test_a_golden_file_that_cannot_be_inflated_is_refused(folder):
    data = bytearray(golden_zip(folder))
    data[data.find(b"PK\x03\x04") + 30 + len("observation.npy")] = 0x07  # no kind of block of deflate
    replace_file(folder, b.GOLDEN, bytes(data))
    with pytest.raises(b.BundleError, match="golden.npz: damaged .*invalid block type"):
        b.load_bundle(folder)


def test_a_golden_file_of_which_a_member_comes_twice_is_refused(folder):
    buffer = io.BytesIO(golden_zip(folder))
    with zipfile.ZipFile(buffer, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("action.npy", array_bytes(np.zeros((4, 2), np.float32)))
    replace_file(folder, b.GOLDEN, buffer.getvalue())
    with pytest.raises(b.BundleError, match="it must hold"):
        b.load_bundle(folder)


@settings(max_examples=100, deadline=None)
@given(
    method=st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]),
    cut=shares,
    whole=st.booleans(),
    flips=st.lists(st.tuples(shares, st.integers(1, 255)), max_size=8),
    noise=st.none() | st.binary(max_size=80),
)
def test_a_damaged_golden_file_is_read_or_refused_in_one_line(tmp_path_factory, method, cut, whole, flips, noise):
    folder = tmp_path_factory.getbasetemp() / "fuzzed-golden"
    if not folder.exists():
        folder.mkdir()
        write_bundle(folder)
        (folder / "kept").write_bytes((folder / b.GOLDEN).read_bytes())
    replace_file(folder, b.GOLDEN, (folder / "kept").read_bytes())
    # flips hit the headers more often where the arrays are not much longer
    image = array_bytes(np.zeros((3, 1, 1, 1), np.uint8))
    members = {"image": image} | ({} if noise is None else {"action": array_bytes(np.zeros((4, 2), "f4"))[:10] + noise})
    data = bytearray(golden_zip(folder, method, **members))
    for at, flip in flips:
        data[int(at * len(data))] ^= flip
    replace_file(folder, b.GOLDEN, bytes(data if whole else data[: int(cut * len(data))]))
    try:
        golden = b.load_bundle(folder).golden
    except b.BundleError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert set(golden) == set(b.GOLDEN_NAMES)


def test_a_folder_that_could_not_be_loaded_gets_no_manifest(tmp_path):
    write_bundle(tmp_path)
    (tmp_path / b.MANIFEST).unlink()
    (tmp_path / b.SKILL).write_bytes(with_external_weights())
    with pytest.raises(b.BundleError, match="external"):
        b.write_manifest(tmp_path, manifest())
    (tmp_path / b.SKILL).write_bytes(skill_bytes(opset=17))
    with pytest.raises(b.BundleError, match="opset"):
        b.write_manifest(tmp_path, manifest())
    assert not (tmp_path / b.MANIFEST).exists()


@given(st.binary(max_size=200))
def test_random_bytes_are_never_taken_for_a_model(data):
    with pytest.raises(OnnxFileError):
        inspect_onnx(data)


@given(
    cut=st.floats(0, 1, exclude_max=True),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255))),
)
def test_a_damaged_model_is_read_or_refused_but_never_breaks_the_reader(cut, flips):
    data = bytearray(planner_bytes())
    for at, flip in flips:
        data[int(at * len(data))] ^= flip
    try:
        facts = inspect_onnx(bytes(data[: len(data) - int(cut * len(data))]))
    except OnnxFileError:
        return
    assert facts.opset >= 0


def test_a_model_nested_without_end_is_refused():
    data = b""
    for _ in range(200):
        data = _field(6, _field(1, _field(5, data)))
    with pytest.raises(OnnxFileError, match="nested deeper"):
        inspect_onnx(_field(7, _field(1, _field(5, data))))


def _field(number: int, payload: bytes) -> bytes:
    length, size = b"", len(payload)
    while size >= 0x80:
        length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + payload


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=200)
@given(data=st.data())
def test_a_manifest_with_any_values_is_refused_or_read(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "fuzzed-manifest"
    if not folder.exists():
        folder.mkdir()
        write_bundle(folder)
    manifest_path = folder / b.MANIFEST
    original = manifest_path.read_bytes()
    values = json.loads(original)
    for _ in range(data.draw(st.integers(1, 3))):
        inside = values
        while isinstance(inside, (dict, list)) and inside:
            keys = sorted(inside) if isinstance(inside, dict) else list(range(len(inside)))
            key = data.draw(st.sampled_from(keys))
            if data.draw(st.booleans()) or not isinstance(inside[key], (dict, list)) or not inside[key]:
                inside[key] = data.draw(json_values)
                break
            inside = inside[key]
    try:
        manifest_path.write_text(json.dumps(values))
        assert b.load_bundle(folder).layout.size >= 0
    except b.BundleError as error:
        assert str(error)
    finally:
        manifest_path.write_bytes(original)


@settings(max_examples=100)
@given(st.binary(max_size=200))
def test_any_bytes_are_no_manifest(tmp_path_factory, noise):
    folder = tmp_path_factory.getbasetemp() / "noise-manifest"
    folder.mkdir(exist_ok=True)
    (folder / b.MANIFEST).write_bytes(noise)
    with pytest.raises(b.BundleError, match=b.MANIFEST):
        b.load_bundle(folder)
