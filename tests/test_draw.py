"""Every world can be drawn, with or without a drive, and the picture shows what is there."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("matplotlib")

from hiernav.draw import OBSTACLE, draw_layout, field_picture
from hiernav.sim.layout import parse_world
from hiernav.sim.worlds import sample_layout

COLLISION_BGR = (0x24, 0x24, 0xE0)
PATH_BGR = (0xB0, 0x6C, 0x2B)
GREMLIN_BGR = (0xD5, 0x5A, 0x80)
OBSTACLE_BGR = (0x68, 0x55, 0x4A)


def drawn(tmp_path: Path, world: str, drive: dict | None = None) -> np.ndarray:
    path = tmp_path / "new folder" / "layout.png"
    draw_layout(sample_layout(parse_world(world), 7), path, drive)
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


def count(picture: np.ndarray, bgr: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - bgr).max(axis=-1) <= 2).sum())


@pytest.mark.parametrize("world", ["pillar(2,2,10)", "two-room", "four-room", "pillar(3,1.5,8)"])
def test_worlds_are_drawn_with_their_obstacles(tmp_path: Path, world: str) -> None:
    picture = drawn(tmp_path, world)
    assert min(picture.shape[:2]) > 500
    assert count(picture, OBSTACLE_BGR) > 5000
    assert count(picture, PATH_BGR) == 0


def test_more_pillars_are_more_ink(tmp_path: Path) -> None:
    few, many = (count(drawn(tmp_path, f"pillar(2,2,{n})"), OBSTACLE_BGR) for n in (3, 12))
    assert many > 3.5 * few


def test_gremlins_are_drawn(tmp_path: Path) -> None:
    assert count(drawn(tmp_path, "gremlin"), GREMLIN_BGR) > 5000


def test_a_map_file_is_drawn(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "hall.png"), np.pad(np.full((60, 80), 254, np.uint8), 10))
    (tmp_path / "hall.yaml").write_text(
        "image: hall.png\nresolution: 0.05\norigin: [3.0, 4.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    assert count(drawn(tmp_path, str(tmp_path / "hall.yaml")), OBSTACLE_BGR) > 50000


@pytest.mark.parametrize(("world", "shape"), [("pillar(2,2,10)", (600, 600)), ("pillar(3,1.5,8)", (308, 600))])
def test_a_picture_of_a_field_is_true_to_scale(world: str, shape: tuple[int, int]) -> None:
    layout = sample_layout(parse_world(world), 7)
    picture = field_picture(layout, 600)
    assert picture.pixels.shape == (*shape, 3)
    columns, rows = np.floor(picture.pixel_of(layout.pillars)).astype(int).T
    obstacle = [int(OBSTACLE[k : k + 2], 16) for k in (1, 3, 5)]
    assert (picture.pixels[rows, columns] == obstacle).all()
    share = (np.abs(picture.pixels.astype(int) - obstacle).max(axis=-1) <= 2).sum() / picture.pixels_per_metre**2
    assert 0.8 < share / (len(layout.pillars) * np.pi * 0.2**2) < 1.05


def test_a_picture_of_a_field_leaves_out_what_moves() -> None:
    picture = field_picture(sample_layout(parse_world("gremlin"), 7), 300)
    assert count(picture.pixels[..., ::-1], GREMLIN_BGR) < 200


def test_a_drive_is_drawn_over_the_layout(tmp_path: Path) -> None:
    line = np.linspace((-1.5, -1.5), (1.5, 1.5), 40)
    drive = {"path": line, "plans": [line[:10], line[10:20]], "collisions": line[[20]], "title": "A drive"}
    picture = drawn(tmp_path, "pillar(2,2,4)", drive)
    assert count(picture, PATH_BGR) > 1000
    assert count(picture, COLLISION_BGR) > 100


def test_an_empty_drive_is_the_layout_alone(tmp_path: Path) -> None:
    empty = {"path": np.zeros((0, 2)), "plans": [], "collisions": []}
    assert (drawn(tmp_path, "pillar(2,2,4)", empty) == drawn(tmp_path, "pillar(2,2,4)")).all()


def test_a_wrong_drive_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="pathh"):
        drawn(tmp_path, "pillar(2,2,4)", {"pathh": np.zeros((3, 2))})
    with pytest.raises(ValueError, match=r"plans\[1\] has shape \(3, 3\)"):
        drawn(tmp_path, "pillar(2,2,4)", {"plans": [np.zeros((10, 2)), np.zeros((3, 3))]})
