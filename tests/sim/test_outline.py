"""The outline of a part encloses every point of it seen from above, and no more."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiernav.config import load_config
from hiernav.sim.factory import make_task
from hiernav.sim.outline import Outlines

SIZES = {"sphere": (0.3, 0, 0), "capsule": (0.1, 0.4, 0), "ellipsoid": (0.1, 0.2, 0.5), "cylinder": (0.2, 0.3, 0),
         "box": (0.1, 0.2, 0.3)}  # fmt: skip
TETRAHEDRON = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)


def outline_of(kind: str, rotation: Rotation, where: tuple[float, float, float] = (1.0, -2.0, 0.5)) -> np.ndarray:
    spec = mujoco.MjSpec()
    quaternion = np.roll(rotation.as_quat(), 1)  # MuJoCo's has the scalar first
    body = spec.worldbody.add_body(name="robot", pos=where, quat=quaternion)
    body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=SIZES[kind])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    (outline,) = Outlines(model)(data)
    return outline


def surface_of(kind: str, rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    """Random points (count, 3) of a solid, in its own frame."""
    x, y, z = SIZES[kind]
    ball = rng.standard_normal((count, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    if kind == "sphere":
        return x * ball
    if kind == "capsule":
        return x * ball + np.array([0.0, 0.0, y]) * rng.choice([-1.0, 1.0], (count, 1))
    if kind == "ellipsoid":
        return ball * SIZES[kind]
    if kind == "cylinder":
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        return np.column_stack([x * np.cos(angle), x * np.sin(angle), y * rng.choice([-1.0, 1.0], count)])
    return rng.choice([-1.0, 1.0], (count, 3)) * SIZES[kind]


@pytest.mark.parametrize("kind", SIZES)
def test_an_outline_is_as_wide_as_the_part_in_every_direction(kind: str) -> None:
    rng = np.random.default_rng(0)
    for rotation in (Rotation.identity(), *Rotation.random(5, rng)):
        points = rotation.apply(surface_of(kind, rng))[:, :2] + (1.0, -2.0)
        outline = outline_of(kind, rotation)
        assert outline.shape == (32, 2)
        for angle in np.linspace(0.0, 2.0 * np.pi, 7):
            direction = np.array([np.cos(angle), np.sin(angle)])
            # between two of its corners a round outline is up to half a percent too narrow
            np.testing.assert_allclose((outline @ direction).max(), (points @ direction).max(), atol=0.01)


def test_a_part_of_any_other_shape_is_shown_by_its_box() -> None:
    spec = mujoco.MjSpec()
    spec.add_mesh(name="part", uservert=TETRAHEDRON.ravel())
    spec.worldbody.add_body(name="robot").add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="part")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    (outline,) = Outlines(model)(data)
    center, half = model.geom_aabb[0].reshape(2, 3)
    box = center + half * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (data.geom_xpos[0] + box @ data.geom_xmat[0].reshape(3, 3).T)[:, :2]
    np.testing.assert_allclose(outline.max(axis=0), corners.max(axis=0), atol=1e-6)
    np.testing.assert_allclose(outline.min(axis=0), corners.min(axis=0), atol=1e-6)


@pytest.mark.parametrize(("robot", "parts", "reach"), [("point", 2, 0.16), ("car", 8, 0.21), ("doggo", 14, 0.4)])
def test_a_robot_is_outlined_where_it_stands_without_floor_and_obstacles(robot: str, parts: int, reach: float) -> None:
    task = make_task(load_config(None, [f"robot={robot}"]), 1)
    task.reset()
    outlines = Outlines(task.sim.model)(task.sim.datas[0])
    assert len(outlines) == parts
    distance = np.linalg.norm(np.concatenate(outlines) - task.pose[0, :2], axis=1)
    assert 0.8 * reach < distance.max() < 1.1 * reach
