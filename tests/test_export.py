"""Claims about export: what the robot runs is what was trained, and a bundle is whole, fitting and unaltered."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tiny_run

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")
onnx = pytest.importorskip("onnx", reason="needs the extra hiernav[train]")

from hiernav import export  # noqa: E402
from hiernav.config import dump_config, load_config  # noqa: E402
from hiernav.evaluate import Policies, make_planner, open_policies  # noqa: E402
from hiernav.export import export_run, record_inputs  # noqa: E402
from hiernav.nav.bundle import HASHED_FILES, MANIFEST, BundleError, file_sha256, load_bundle  # noqa: E402
from hiernav.nav.option import Planner, PlanQuery  # noqa: E402
from hiernav.planner.train import load_network  # noqa: E402
from hiernav.run import Run, RunError  # noqa: E402
from hiernav.runtime.policy import check_golden, load_networks, make_agent  # noqa: E402
from hiernav.sim.factory import make_task  # noqa: E402
from hiernav.sim.layout import parse_world  # noqa: E402
from hiernav.sim.robots import get_robot  # noqa: E402
from hiernav.sim.worlds import sample_layout  # noqa: E402
from hiernav.skill.train import load_actor  # noqa: E402

pytestmark = pytest.mark.train
RECORDED = 1000


@pytest.fixture(scope="module")
def both(able_run: Path, able_bundle: Path) -> tuple[Policies, Policies]:
    """The same pair in torch and in ONNX Runtime."""
    return open_policies(able_run), open_policies(able_bundle)


@pytest.fixture(scope="module")
def recorded(able_run: Path) -> dict[str, np.ndarray]:
    """What both networks were shown while they drove; the goal is reached now and then, so worlds change."""
    run = Run.open(able_run)
    network, actor = load_network(run.config, run.load("planner")), load_actor(run.config, run.load("skill"))
    return record_inputs(tiny_run.config(able_run, "option.period=1"), network, actor, RECORDED)


@pytest.fixture
def bundle(able_bundle: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return Path(shutil.copytree(able_bundle, tmp_path / "bundle"))


def edit_manifest(bundle: Path, **changes: object) -> None:
    file = bundle / MANIFEST
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_recorded_inputs_are_as_many_as_asked_for_and_differ(recorded):
    assert recorded["observation"].shape == (RECORDED, 42)
    assert recorded["image"].shape == (RECORDED, 4, 64, 64)
    assert recorded["distance"].shape == (RECORDED,)
    assert len(np.unique(recorded["observation"], axis=0)) > 900
    assert len(np.unique(recorded["distance"])) > 900


def test_the_exported_skill_gives_the_trained_ones_actions(both, recorded):
    trained, exported = both
    expected = trained.skill(recorded["observation"])
    assert np.ptp(expected, axis=0).min() > 1.0
    together = exported.skill(recorded["observation"])
    alone = np.concatenate([exported.skill(row[None]) for row in recorded["observation"]])
    for action in (together, alone):
        assert np.abs(action - expected).max() <= 1e-5


def test_the_exported_planner_gives_the_trained_ones_waypoints(both, recorded):
    trained, exported = both
    expected, scores = trained.network(recorded["image"], recorded["distance"])
    waypoints, rated = exported.network(recorded["image"], recorded["distance"])
    assert np.ptp(expected) > 0.5
    assert np.abs(waypoints - expected).max() <= 1e-5  # [m]
    assert np.abs(rated - scores).max() <= 1e-4


@pytest.mark.parametrize("rows", [1, 7, 64])
def test_any_number_of_robots_is_served_at_once(both, recorded, rows):
    _, exported = both
    assert exported.skill(recorded["observation"][:rows]).shape == (rows, 2)
    waypoints, scores = exported.network(recorded["image"][:rows], recorded["distance"][:rows])
    assert waypoints.shape == (rows, 2, 10, 2) and scores.shape == (rows, 2)
    again, _ = exported.network(recorded["image"][:1], recorded["distance"][:1])
    np.testing.assert_allclose(waypoints[0], again[0], atol=1e-5)


class Doubled:
    """Plans as one pair does, and notes how far off the other one is when it is asked the same [m]."""

    def __init__(self, leading: Planner, following: Planner) -> None:
        self.leading, self.following = leading, following
        self.apart: list[float] = []

    def plan(self, query: PlanQuery) -> np.ndarray:
        plan = self.leading.plan(query)
        self.apart.append(float(np.abs(plan - self.following.plan(query)).max()))
        return plan


@pytest.mark.parametrize("leader", ["torch", "onnx"])
def test_whichever_drives_the_other_would_have_done_the_same(both, leader):
    """Same inputs at every step: an action comes back through the accelerometer, so that two closed loops drift apart
    within a few steps, however little their networks differ."""
    leading, following = both if leader == "torch" else both[::-1]
    layout = sample_layout(parse_world("pillar(2,2,3)"), 12)
    planner = Doubled(make_planner(leading, "cnn"), make_planner(following, "cnn"))
    task = make_task(leading.config, 1, planner, [layout.spec], lambda row: layout)
    task.reset()
    for _ in range(50):
        action = leading.skill(task.observation)
        assert np.abs(action - following.skill(task.observation)).max() <= 1e-4
        assert not task.step(action).terminated[0]
    assert len(planner.apart) >= 2 and max(planner.apart) <= 1e-4
    assert np.linalg.norm(task.pose[0, :2] - layout.start[:2]) > 0.3


def test_a_bundle_has_four_files_of_modest_size_with_all_weights_inside(able_bundle):
    assert {file.name for file in able_bundle.iterdir()} == {*HASHED_FILES, MANIFEST}
    for name in ("planner.onnx", "skill.onnx"):
        assert 1_000 < (able_bundle / name).stat().st_size < 50_000_000
        model = onnx.load(able_bundle / name, load_external_data=False)
        onnx.checker.check_model(model)
        assert not any(tensor.external_data for tensor in model.graph.initializer)
        assert {node.domain for node in model.graph.node} <= {"", "ai.onnx"}


def test_the_manifest_holds_what_the_networks_assume(able_bundle, able_run):
    config, manifest = Run.open(able_run).config, load_bundle(able_bundle).manifest
    robot = get_robot("point")
    assert (manifest.robot, manifest.robot_sha256) == ("point", file_sha256(robot.xml_path))
    assert manifest.control_period_s == robot.control_period
    assert manifest.replan.d_update_m == config.option.d_update_m
    assert manifest.plan.planning_radius_m == robot.radius
    assert manifest.plan.soft_margin_m == config.planner.soft_margin_m
    assert load_bundle(able_bundle).layout == get_robot("point").observation_layout()
    assert manifest.provenance["skill_steps"] == 768 and manifest.provenance["seed"] == 3


def test_the_manifest_tells_which_code_trained_and_with_which_settings(able_run, tmp_path):
    run = Run.open(shutil.copytree(able_run, tmp_path / "run"))
    (began,) = run.codes()
    for code in ("abc with changes", began, "abc with changes"):
        run.note_code(code)
    run.close()
    provenance = load_bundle(export_run(run.path, tmp_path / "bundle")).manifest.provenance
    assert provenance["code"] == f"{began}, abc with changes"
    assert load_config(None, shlex.split(provenance["settings"])) == msgspec.structs.replace(run.config, run_dir=None)


def test_the_manifest_names_no_place_of_the_machine_that_trained(able_run, tmp_path):
    run = Path(shutil.copytree(able_run, tmp_path / "run"))
    private = ["planner.data=/home/somebody/data", "skill.ray_address=ray://10.0.0.7:10001", "skill.collector=ray"]
    (run / "config.yaml").write_text(dump_config(load_config(run / "config.yaml", private)))
    settings = str(load_bundle(export_run(run, tmp_path / "bundle")).manifest.provenance["settings"])
    assert 'skill.collector="ray"' in settings and "somebody" not in settings and "10.0.0.7" not in settings


def test_the_manifest_holds_the_rule_and_the_plans_as_they_were_configured(able_run, tmp_path, monkeypatch):
    run, told = Run.open(able_run), []
    network, actor = load_network(run.config, run.load("planner")), load_actor(run.config, run.load("skill"))
    for name in ("_export", "load_bundle", "check_golden"):
        monkeypatch.setattr(export, name, lambda *_: None)
    monkeypatch.setattr(export, "write_manifest", lambda _, manifest: told.append(manifest))
    rule = ("d_update_m=0.41", "half_fraction=0.7", "invalid=false", "period=16")
    plans = ("planner.planning_radius_m=0.13", "planner.soft_margin_m=0.07")
    config = tiny_run.config(able_run, *(f"option.{text}" for text in rule), *plans)
    export.write_bundle(tmp_path, config, network, actor, {})
    (manifest,) = told
    replan, plan = manifest.replan, manifest.plan
    assert (replan.d_update_m, replan.half_fraction, replan.invalid, replan.period) == (0.41, 0.7, False, 16)
    assert (plan.waypoints, plan.spacing_m, plan.planning_radius_m, plan.soft_margin_m) == (10, 0.1, 0.13, 0.07)


def test_the_papers_planner_and_another_robot_are_exported_too(doggo_bundle):
    loaded, robot = load_bundle(doggo_bundle), get_robot("doggo")
    loaded.require_robot("doggo", file_sha256(robot.xml_path))
    loaded.require_layout(get_robot("doggo").observation_layout())
    assert loaded.manifest.planner.preset == "paper" and loaded.manifest.planner.channels == 6
    assert max(check_golden(loaded).values()) <= 1e-5
    agent = make_agent(loaded, robot.radius)
    assert agent.layout.size == 78 and agent.option.sweep_radius == robot.radius


@pytest.mark.parametrize("name", HASHED_FILES)
def test_one_changed_byte_is_noticed(bundle, name):
    data = bytearray((bundle / name).read_bytes())
    data[len(data) // 2] ^= 1
    (bundle / name).write_bytes(data)
    with pytest.raises(BundleError, match=f"{name}: SHA-256 differs from the manifest"):
        open_policies(bundle)


def test_a_network_that_was_altered_with_its_hash_fails_on_the_golden_inputs(bundle):
    """Who can write the manifest can write the hashes; the golden outputs then still tell."""
    model = onnx.load(bundle / "skill.onnx")
    weight = max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    changed = onnx.numpy_helper.to_array(weight) * np.float32(1.001)
    weight.CopyFrom(onnx.numpy_helper.from_array(changed, weight.name))
    onnx.save(model, bundle / "skill.onnx")
    files = json.loads((bundle / MANIFEST).read_text())["files"]
    edit_manifest(bundle, files=files | {"skill.onnx": file_sha256(bundle / "skill.onnx")})
    with pytest.raises(BundleError, match="golden action: off by"):
        load_networks(load_bundle(bundle))


def test_a_bundle_for_another_robot_is_refused_by_name(bundle):
    with pytest.raises(BundleError, match="robot: the bundle is for 'point', this is 'car'"):
        load_bundle(bundle).require_robot("car", "0" * 64)
    edit_manifest(bundle, robot="car")
    with pytest.raises(BundleError, match="robot_sha256: the model of 'car' has changed"):
        open_policies(bundle)


def test_a_bundle_with_another_observation_is_refused_by_field(bundle):
    fields = json.loads((bundle / MANIFEST).read_text())["observation"]
    fields[4]["scale"] = 3.0
    edit_manifest(bundle, observation=fields)
    with pytest.raises(BundleError, match=r"observation\[4\] 'lidar': scale is 3\.0 in the bundle, 1\.0 on this robot"):
        open_policies(bundle)


def test_a_bundle_of_a_newer_format_is_refused_with_what_to_do(bundle):
    edit_manifest(bundle, format_version=2, something_new=True)
    with pytest.raises(BundleError, match=r"format_version 2 was made by a newer hiernav .*: upgrade hiernav"):
        open_policies(bundle)


def test_a_bundle_is_replaced_as_a_whole_or_stays(able_run, able_bundle, bundle, monkeypatch):
    before = {file.name: file.read_bytes() for file in bundle.iterdir()}
    edit_manifest(bundle, format_version=2)  # of no more use
    (bundle / "golden.npz").write_bytes(b"damaged")
    old = {file.name: file.read_bytes() for file in bundle.iterdir()}

    def write(folder: Path, *_: object) -> None:
        shutil.copy(able_bundle / "skill.onnx", folder)
        assert {file.name: file.read_bytes() for file in bundle.iterdir()} == old
        if failing:
            raise BundleError("golden action: off by 1")
        shutil.copytree(able_bundle, folder, dirs_exist_ok=True)

    monkeypatch.setattr(export, "write_bundle", write)
    failing = True
    with pytest.raises(BundleError, match="golden action"):
        export_run(able_run, bundle)
    assert {file.name: file.read_bytes() for file in bundle.iterdir()} == old
    assert [path.name for path in bundle.parent.iterdir()] == ["bundle"]

    failing = False
    assert export_run(able_run, bundle) == bundle
    assert {file.name: file.read_bytes() for file in bundle.iterdir()} == before
    assert [path.name for path in bundle.parent.iterdir()] == ["bundle"]


def test_a_folder_that_is_no_bundle_is_not_replaced(able_run, tmp_path):
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter.tex").write_text("two years of work")
    with pytest.raises(RunError, match="is not a bundle and not empty: choose another folder"):
        export_run(able_run, precious)
    with pytest.raises(RunError, match="is not a bundle"):
        export_run(able_run, precious / "chapter.tex")
    assert (precious / "chapter.tex").read_text() == "two years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["thesis"]


@pytest.mark.parametrize(
    ("manifest", "other"),
    [
        ('{"name": "My app", "display": "standalone"}', "src/thesis.txt"),
        ('{"name": "My app", "display": "standalone"}', None),
        ('{"format_version": 1}', "thesis.txt"),
        ('{"format_version": 1}', "planner.onnx/thesis.txt"),
        ("{", None),
    ],
)
def test_only_a_bundle_is_replaced_whatever_else_has_a_manifest(able_run, tmp_path, manifest, other):
    folder = tmp_path / "webapp"
    folder.mkdir()
    (folder / MANIFEST).write_text(manifest)
    if other:
        (folder / other).parent.mkdir(exist_ok=True)
        (folder / other).write_text("two years of work")
    with pytest.raises(RunError, match="is not a bundle and not empty: choose another folder") as error:
        export_run(able_run, folder)
    assert "\n" not in str(error.value)
    assert (folder / MANIFEST).read_text() == manifest
    assert other is None or (folder / other).read_text() == "two years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["webapp"]


@pytest.mark.parametrize("stop", [OSError("disk"), KeyboardInterrupt()])
@pytest.mark.parametrize("after", [False, True])
def test_the_old_bundle_comes_back_when_the_exchange_is_stopped(
    able_run, able_bundle, bundle, monkeypatch, stop, after
):
    old = {file.name: file.read_bytes() for file in bundle.iterdir()}
    rename = Path.rename

    def stopped(source: Path, target: Path) -> Path:
        """Fails before the new bundle is in its place, or is interrupted after the old one has left it."""
        if source.name == "bundle" and source.parent != bundle.parent and not after:
            raise stop
        moved = rename(source, target)
        if source == bundle and after:
            raise stop
        return moved

    monkeypatch.setattr(export, "write_bundle", lambda folder, *_: (folder / "skill.onnx").write_text("new"))
    monkeypatch.setattr(Path, "rename", stopped)
    with pytest.raises(type(stop)):
        export_run(able_run, bundle)
    assert {file.name: file.read_bytes() for file in bundle.iterdir()} == old
    assert [path.name for path in bundle.parent.iterdir()] == ["bundle"]


@pytest.mark.parametrize("stage", ["planner", "skill"])
def test_a_run_that_lacks_a_stage_is_refused_with_a_hint_and_writes_nothing(able_run, tmp_path, stage):
    run = Path(shutil.copytree(able_run, tmp_path / "run"))
    (run / stage / "checkpoint.pt").unlink()
    with pytest.raises(RunError, match=f"has no trained {stage} yet: go on with `hiernav train --resume {run}`"):
        export_run(run, tmp_path / "bundle")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_planner_that_was_stopped_early_is_refused_with_how_to_go_on(able_run, tmp_path):
    run = Run.open(shutil.copytree(able_run, tmp_path / "run"))
    run.save("planner", {**run.load("planner"), "epoch": 1})
    run.close()
    hint = f"is trained for 1 of 2 epochs: go on with `hiernav train --resume {run.path} --stage planner`"
    with pytest.raises(RunError, match=hint):
        export_run(run.path, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_what_is_not_known_of_a_skill_is_left_out_of_the_manifest(able_run, tmp_path):
    run = Run.open(shutil.copytree(able_run, tmp_path / "run"))
    skill = run.load("skill")
    run.save("skill", {**skill, "evaluations": [skill["evaluations"][-1] | {"reach_rate": float("nan")}]})
    run.close()
    provenance = load_bundle(export_run(run.path, tmp_path / "bundle")).manifest.provenance
    assert "skill_reach_rate" not in provenance and provenance["skill_steps"] == 768
    assert "NaN" not in (tmp_path / "bundle" / "manifest.json").read_text()


def test_a_skill_without_an_evaluation_is_refused(able_run, tmp_path):
    run = Run.open(shutil.copytree(able_run, tmp_path / "run"))
    run.save("skill", {**run.load("skill"), "best_actor": None, "evaluations": []})
    with pytest.raises(RunError, match="not been evaluated yet: train for longer"):
        export_run(run.path, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
