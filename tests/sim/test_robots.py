from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hiernav.sim.robots import BASE_SENSORS, ROBOTS, JointReader, get_robot
from hiernav.sim.scene import SceneSpec, build_model

REFERENCE = Path(__file__).parents[1] / "data" / "reference"
LEGS = (1, 2, 3, 4)
# the rollouts are chaotic and were recorded with this release; other releases may round differently
SAME_RELEASE = mujoco.__version__ == "4.0.0"
REFERENCE_STEPS, REFERENCE_TOLERANCE = (200, 1e-6) if SAME_RELEASE else (10, 1e-3)

every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS.keys())


def reference(name: str) -> dict[str, np.ndarray]:
    with np.load(REFERENCE / f"{name}_rollout.npz") as file:
        return dict(file)


def random_state(model: mujoco.MjModel, seed: int) -> mujoco.MjData:
    """Any pose and any joint angles, after mj_forward."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    mujoco.mj_integratePos(model, data.qpos, rng.uniform(-3, 3, model.nv), 1.0)
    data.qvel[:] = rng.uniform(-1, 1, model.nv)
    mujoco.mj_forward(model, data)
    return data


@every_robot
def test_robot_moves_as_the_original_does(robot):
    expected = reference(robot.name)
    model = build_model(robot, SceneSpec(pillars=1))
    data = mujoco.MjData(model)
    data.mocap_pos[0] = [*expected["pillar_xy"], expected["pillar_half_height"]]
    robot.place(data.qpos, expected["start_xy_yaw"])
    mujoco.mj_forward(model, data)
    assert model.opt.timestep == expected["timestep"] and robot.substeps == expected["substeps"]
    for step in range(REFERENCE_STEPS + 1):
        body = data.body("robot")
        assert_allclose(body.xpos, expected["robot_pos"][step], rtol=0, atol=REFERENCE_TOLERANCE)
        assert_allclose(body.xmat.reshape(3, 3), expected["robot_mat"][step], rtol=0, atol=10 * REFERENCE_TOLERANCE)
        if SAME_RELEASE:
            for name in BASE_SENSORS:
                # accelerations jump at contacts
                assert_allclose(data.sensor(name).data, expected[f"sensor_{name}"][step], rtol=0, atol=1e-3)
        if step < REFERENCE_STEPS:
            data.ctrl[:] = expected["ctrl"][step]
            mujoco.mj_step(model, data, nstep=robot.substeps)


@pytest.mark.parametrize(("name", "mass"), [("point", 0.0051888), ("car", 0.030445), ("doggo", 0.039680)])
def test_robot_weighs_what_the_fact_sheet_says(name, mass):
    model = build_model(get_robot(name), SceneSpec())
    assert model.body("robot").subtreemass[0] == pytest.approx(mass, abs=1e-6)


@pytest.mark.parametrize(
    ("name", "actions", "extra", "period"), [("point", 2, 0, 0.02), ("car", 2, 12, 0.04), ("doggo", 12, 36, 0.1)]
)
def test_robot_has_the_sizes_of_the_paper(name, actions, extra, period):
    robot = get_robot(name)
    model = build_model(robot, SceneSpec())
    assert robot.action_dim == actions == model.nu
    assert sum(term.size for term in robot.own_terms) == extra
    assert robot.control_period == pytest.approx(period)
    assert model.opt.timestep == robot.timestep


@every_robot
def test_actuators_keep_the_order_of_the_original(robot):
    model = build_model(robot, SceneSpec())
    names = [model.actuator(i).name for i in range(model.nu)]
    assert names == reference(robot.name)["actuator_names"].tolist()
    assert_allclose(model.actuator_ctrlrange, np.tile([-1.0, 1.0], (model.nu, 1)))


@every_robot
def test_every_geom_has_rolling_friction(robot):
    model = build_model(robot, SceneSpec(pillars=1, gremlins=1, bricks=1, boxes=((1.0, 1.0, 0.1, 0.1),)))
    assert (model.geom_condim == 6).all()


@every_robot
@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (1.2, -0.7, 2.5), (-3.0, 0.4, -3.1)])
def test_robot_is_placed_where_it_is_asked_to_stand(robot, pose):
    model = build_model(robot, SceneSpec())
    data = mujoco.MjData(model)
    robot.place(data.qpos, np.array(pose))
    mujoco.mj_forward(model, data)
    x, y, yaw = pose
    assert_allclose(data.body("robot").xpos, [x, y, robot.start_height], atol=1e-12)
    assert_allclose(data.body("robot").xmat[[0, 3, 6]], [np.cos(yaw), np.sin(yaw), 0.0], atol=1e-12)
    assert_allclose(robot.pose(data.qpos[None])[0], pose, atol=1e-12)
    assert robot.upright(data.qpos[None])[0] == pytest.approx(1.0)


@every_robot
@pytest.mark.parametrize("seed", range(5))
def test_pose_of_a_tilted_robot_is_that_of_its_body_frame(robot, seed):
    data = random_state(build_model(robot, SceneSpec()), seed)
    body = data.body("robot")
    yaw = np.arctan2(body.xmat[3], body.xmat[0])
    assert_allclose(robot.pose(data.qpos[None])[0], [*body.xpos[:2], yaw], atol=1e-12)
    assert_allclose(robot.upright(data.qpos[None]), body.xmat[8], atol=1e-12)


@every_robot
def test_yaw_never_reads_plus_pi(robot):
    qpos = build_model(robot, SceneSpec()).qpos0[None].copy()
    robot.place(qpos[0], np.array([0.0, 0.0, np.pi]))
    assert -np.pi <= robot.pose(qpos)[0, 2] < np.pi


@pytest.mark.parametrize("seed", range(5))
def test_rear_ball_of_the_car_is_read_relative_to_the_car(seed):
    car = get_robot("car")
    model = build_model(car, SceneSpec())
    data = random_state(model, seed)
    terms = JointReader(car, model).read(data.qpos[None], data.qvel[None])
    relative = data.body("robot").xmat.reshape(3, 3).T @ data.body("rear").xmat.reshape(3, 3)
    assert_allclose(terms["rear_rotation"][0], relative.reshape(9), atol=1e-12)
    assert_allclose(terms["rear_velocity"][0], data.joint("rear").qvel)


def test_joints_of_the_doggo_are_read_in_the_order_of_its_motors():
    doggo = get_robot("doggo")
    model = build_model(doggo, SceneSpec())
    data = random_state(model, 0)
    terms = JointReader(doggo, model).read(data.qpos[None], data.qvel[None])
    names = [*(f"hip_{i}_z" for i in LEGS), *(f"hip_{i}_y" for i in LEGS), *(f"ankle_{i}" for i in LEGS)]
    angles = np.array([data.joint(name).qpos[0] for name in names])
    assert_allclose(terms["joint_sin"][0], np.sin(angles))
    assert_allclose(terms["joint_cos"][0], np.cos(angles))
    assert_allclose(terms["joint_velocity"][0], [data.joint(name).qvel[0] for name in names])
    assert [model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)] == names


def test_every_extra_term_is_read_with_its_declared_size():
    for robot in ROBOTS.values():
        model = build_model(robot, SceneSpec())
        terms = JointReader(robot, model).read(np.tile(model.qpos0, (3, 1)), np.zeros((3, model.nv)))
        assert [(name, value.shape) for name, value in terms.items()] == [
            (term.name, (3, term.size)) for term in robot.own_terms
        ]


def test_unknown_robot_is_refused_with_the_known_names():
    with pytest.raises(ValueError, match="'cat'; accepted: point, car, doggo"):
        get_robot("cat")


def test_simulation_runs_on_a_machine_without_a_display():
    code = "from hiernav.sim import batch, robots, scene; batch.BatchSim(robots.ROBOTS['point'], 1, scene.SceneSpec())"
    headless = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "MUJOCO_GL")}
    result = subprocess.run([sys.executable, "-c", code], env=headless, capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (0, "")
