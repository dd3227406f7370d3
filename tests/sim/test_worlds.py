"""Worlds are what their names say, the same for the same seed, and never impossible."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hiernav.nav.goal import GOAL_RADIUS
from hiernav.nav.lidar import PILLAR_RADIUS
from hiernav.nav.search import is_solvable
from hiernav.sim.layout import GREMLIN_HALF_SIZE, GREMLIN_ORBIT, WALL_THICKNESS, Layout, WorldSpec, parse_world
from hiernav.sim.worlds import WorldError, sample_layout

PAPER_WORLDS = ["pillar(2,2,10)", "pillar(3,3,25)", "pillar(4,4,40)", "gremlin", "two-room", "four-room"]
SMALL_WORLDS = ["pillar(2,2,10)", "gremlin", "two-room", "four-room"]
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def map_path(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A hall of 6 x 4 m, its corner at (3, 4), with two walls and a closet that nothing can enter."""
    folder = tmp_path_factory.mktemp("maps")
    picture = np.full((80, 120), 254, np.uint8)
    picture[:2] = picture[-2:] = picture[:, :2] = picture[:, -2:] = 0
    picture[:50, 40:44] = picture[30:, 80:84] = 0
    picture[2:20, 100:102] = picture[18:20, 100:] = 0
    cv2.imwrite(str(folder / "hall.png"), picture)
    path = folder / "hall.yaml"
    path.write_text(
        "image: hall.png\nresolution: 0.05\norigin: [3.0, 4.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    return str(path)


def numbers(layout: Layout) -> np.ndarray:
    parts = (layout.start, layout.goal, layout.pillars, layout.gremlins, layout.walls)
    return np.concatenate([part.ravel() for part in parts])


def room_of(point: np.ndarray, kind: str) -> tuple[bool, bool]:
    return bool(point[1] > 0), bool(point[0] > 0) and kind == "four-room"


# names


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("pillar(2,2,10)", WorldSpec("pillar", 2.0, 2.0, 10, 300)),
        ("pillar(3,3,25)", WorldSpec("pillar", 3.0, 3.0, 25, 450)),
        ("pillar(4,4,40)", WorldSpec("pillar", 4.0, 4.0, 40, 600)),
        (" pillar( 2.5, 1.5 , 0 ) ", WorldSpec("pillar", 2.5, 1.5, 0, 375)),
        ("gremlin", WorldSpec("gremlin", 2.0, 2.0, 10, 300)),
        ("gremlin(3,2,5)", WorldSpec("gremlin", 3.0, 2.0, 5, 450)),
        ("two-room", WorldSpec("two-room", 2.0, 2.0, 0, 600)),
        ("two-room(3,3)", WorldSpec("two-room", 3.0, 3.0, 0, 900)),
        ("four-room", WorldSpec("four-room", 2.0, 2.0, 0, 600)),
    ],
)
def test_a_world_is_parsed_from_its_name(text: str, expected: WorldSpec) -> None:
    assert parse_world(text) == expected


@given(
    st.sampled_from(["pillar", "gremlin", "two-room", "four-room"]),
    st.floats(1.4, 400.0),
    st.floats(1.4, 400.0),
    st.integers(0, 2000),
)
def test_the_name_of_a_world_gives_the_world_back(kind: str, width: float, height: float, count: int) -> None:
    sizes = [repr(width), repr(height)] + [str(count)] * (kind in ("pillar", "gremlin"))
    spec = parse_world(f"{kind}({','.join(sizes)})")
    assert parse_world(str(spec)) == spec
    assert (spec.half_width, spec.half_height) == (width, height)


@pytest.mark.parametrize("name", PAPER_WORLDS)
def test_the_paper_s_names_are_canonical(name: str) -> None:
    assert str(parse_world(name)) == name


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "unknown; accepted are pillar"),
        ("maze", "'maze': unknown"),
        ("pillar", "sizes are missing"),
        ("pillar()", "1 arguments"),
        ("pillar(2,2)", r"2 arguments, pillar\(W,H,N\) takes 3"),
        ("two-room(2,2,3)", r"3 arguments, two-room\(W,H\) takes 2"),
        ("pillar(2,2,x)", "must be numbers"),
        ("pillar(2,2,1.5)", "N a whole number"),
        ("pillar(2,2,-1)", "N = -1 obstacles, it must be between 0 and 2000"),
        ("pillar(2,2,2001)", "N = 2001"),
        ("pillar(0.1,2,3)", r"W = 0.1 m, it must be between 0.5 and 400.0 m"),
        ("pillar(2,1e9,3)", r"H = 1e\+09 m"),
        ("pillar(nan,2,3)", "W = nan"),
        ("four-room(1,2)", "W = 1 m, it must be between 1.4"),
        ("pillar(2,2,10", "unknown"),
        ("map(none.yaml)", "none.yaml.*cannot be read"),
        ("map(no\0ne.yaml)", "no.x00ne.yaml.*cannot be read .*embedded null"),
        ("none.yaml", "none.yaml.*cannot be read"),
    ],
)
def test_what_is_wrong_with_a_name_is_said_in_one_line(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as caught:
        parse_world(text)
    assert "\n" not in str(caught.value)


# sampling


@pytest.mark.parametrize("name", PAPER_WORLDS)
@pytest.mark.parametrize("seed", [0, 1, 2**63])
def test_the_same_seed_is_the_same_world(name: str, seed: int) -> None:
    first, second = sample_layout(parse_world(name), seed), sample_layout(parse_world(name), seed)
    assert (numbers(first) == numbers(second)).all()
    assert (numbers(first) != numbers(sample_layout(parse_world(name), seed + 1)))[:5].all()


@pytest.mark.parametrize(
    ("name", "checksum"),
    [
        ("pillar(2,2,10)", "6d2707f5169e861a"),
        ("gremlin", "4f3867e873ffdd99"),
        ("two-room", "0274fb0c1900b3de"),
        ("four-room", "d705ace74adfd399"),
        ("map", "f27c936b43006a17"),
    ],
)
def test_seed_7_is_the_same_world_on_every_machine(name: str, checksum: str, map_path: str) -> None:
    layout = sample_layout(parse_world(map_path if name == "map" else name), 7)
    text = ",".join(f"{value:.9f}" for value in numbers(layout))
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == checksum


@given(seeds, st.floats(1.5, 5.0), st.floats(1.5, 5.0), st.floats(0.0, 0.9), st.booleans())
@settings(max_examples=40)
def test_things_keep_their_distances(seed: int, width: float, height: float, fill: float, moving: bool) -> None:
    kind, keep_out = ("gremlin", 0.3 + 0.1 * math.sqrt(2.0)) if moving else ("pillar", 0.3)
    count = int(fill * 0.4 * 4 * width * height / (math.pi * keep_out**2))
    layout = sample_layout(parse_world(f"{kind}({width!r},{height!r},{count})"), seed, robot_radius=0.05)
    obstacles = layout.gremlins if moving else layout.pillars
    assert len(obstacles) == count and len(layout.gremlins) + len(layout.pillars) == count
    points = np.concatenate((layout.start[None, :2], layout.goal[None], obstacles))
    keep_outs = np.array([0.4, 0.4] + [keep_out] * count)
    distance = np.linalg.norm(points[:, None] - points, axis=-1) + 1e3 * np.eye(len(points))
    assert (distance >= keep_outs[:, None] + keep_outs - 1e-9).all()
    assert (np.abs(points) <= np.array([width, height]) - keep_outs[:, None] + 1e-9).all()


@pytest.mark.parametrize("name", SMALL_WORLDS)
@given(seed=seeds)
@settings(max_examples=25)
def test_every_world_can_be_solved_by_its_robot(name: str, seed: int) -> None:
    layout = sample_layout(parse_world(name), seed, robot_radius=0.2)
    assert is_solvable(layout.occupancy(0.0), layout.start[:2], layout.goal, 0.2)
    assert np.linalg.norm(layout.goal - layout.start[:2]) > GOAL_RADIUS
    assert layout.in_field(np.stack((layout.start[:2], layout.goal))).all()


def test_headings_fill_the_circle() -> None:
    headings = np.array([sample_layout(parse_world("two-room"), seed).start[2] for seed in range(200)])
    assert (headings >= -np.pi).all() and (headings < np.pi).all()
    assert np.histogram(headings, bins=8, range=(-np.pi, np.pi))[0].min() >= 10


@pytest.mark.parametrize(("name", "openings", "width"), [("two-room", 1, 1.0), ("four-room", 4, 0.8)])
@given(seed=seeds, half=st.floats(1.4, 6.0))
@settings(max_examples=30)
def test_rooms_have_their_openings_and_two_different_rooms(
    name: str, openings: int, width: float, seed: int, half: float
) -> None:
    layout = sample_layout(parse_world(f"{name}({half!r},{half!r})"), seed, robot_radius=0.2)
    lengths = np.abs(layout.walls[:, 2:] - layout.walls[:, :2])
    assert (lengths.min(axis=1) == 0.0).all() and (lengths.max(axis=1) >= 0.3 - 1e-9).all()
    wall_lines = 1 if name == "two-room" else 2
    assert lengths.sum() == pytest.approx(wall_lines * 2.0 * half - openings * width)
    assert len(layout.walls) == 2 * openings
    assert room_of(layout.start, name) != room_of(layout.goal, name)
    to_wall = np.abs(layout.goal[1]) if name == "two-room" else np.abs(layout.goal).min()
    assert to_wall >= 0.4 + WALL_THICKNESS / 2


def test_every_pair_of_rooms_occurs_and_openings_move() -> None:
    layouts = [sample_layout(parse_world("four-room"), seed) for seed in range(120)]
    assert len({(room_of(item.start, "four-room"), room_of(item.goal, "four-room")) for item in layouts}) == 12
    ends = np.array([item.walls[0, 2] for item in layouts])
    assert ends.min() < -0.8 and ends.max() > -0.5


def test_an_opening_in_a_wall_lets_a_wide_robot_pass_and_the_wall_does_not() -> None:
    layout = sample_layout(parse_world("two-room"), 3)
    field = layout.occupancy(0.0)
    (_, _, left, _), (right, _, _, _) = layout.walls
    assert right - left == pytest.approx(1.0)
    assert field.clearance_at((0.5 * (left + right), 0.0)) == pytest.approx(0.5, abs=0.03)
    assert field.clearance_at((left - 0.1, 0.0)) == 0.0


def test_unsolvable_layouts_are_drawn_again_and_counted() -> None:
    spec = parse_world("pillar(2,2,14)")
    redraws = np.array([sample_layout(spec, seed, robot_radius=0.25).redraws for seed in range(60)])
    assert redraws.max() >= 1
    seed = int(redraws.argmax())
    again, first = sample_layout(spec, seed, 0.25), sample_layout(spec, seed, 0.02)
    assert first.redraws == 0 and (numbers(first) != numbers(again)).all()
    assert not is_solvable(first.occupancy(0.0), first.start[:2], first.goal, 0.25)


@pytest.mark.parametrize("name", ["pillar(1,1,50)", "pillar(1,1,7)", "pillar(0.5,0.5,0)", "gremlin(1,1,3)"])
def test_a_world_without_room_is_an_error_that_says_what_to_do(name: str) -> None:
    with pytest.raises(WorldError, match=r"(pillar|gremlin).*tries.*fewer obstacles") as caught:
        sample_layout(parse_world(name), 0)
    assert name in str(caught.value)


def test_a_robot_too_wide_for_its_world_is_an_error() -> None:
    with pytest.raises(WorldError, match=r"100 layouts.*radius 0\.45 m.*smaller robot"):
        sample_layout(parse_world("four-room"), 0, robot_radius=0.45)


@pytest.mark.parametrize("radius", [0.0, -1.0, math.nan, math.inf])
def test_a_robot_without_a_size_is_refused(radius: float) -> None:
    with pytest.raises(ValueError, match="robot_radius"):
        sample_layout(parse_world("two-room"), 0, radius)


def test_a_negative_seed_is_refused() -> None:
    with pytest.raises(ValueError, match="seed -1"):
        sample_layout(parse_world("two-room"), -1)


# what a layout looks like


@pytest.mark.parametrize("name", PAPER_WORLDS)
def test_the_map_is_the_geometry(name: str) -> None:
    layout = sample_layout(parse_world(name), 11)
    field = layout.occupancy(0.0)
    assert field.resolution == 0.05
    width, height = layout.half_size
    assert field.extent == pytest.approx((-width, width, -height, height))
    pixels = field.pixel_centers()
    depth = np.full(field.occupied.shape, -np.inf)
    disc_radius = PILLAR_RADIUS if len(layout.pillars) else GREMLIN_HALF_SIZE * math.sqrt(2.0)
    for center in np.concatenate((layout.pillars, layout.gremlin_positions(0.0))):
        depth = np.maximum(depth, disc_radius - np.linalg.norm(pixels - center, axis=-1))
    for x0, y0, x1, y1 in layout.walls:
        middle = np.array([x0 + x1, y0 + y1]) / 2
        half = np.maximum(np.abs([x1 - x0, y1 - y0]) / 2, WALL_THICKNESS / 2)
        depth = np.maximum(depth, (half - np.abs(pixels - middle)).min(axis=-1))
    assert field.occupied[depth > 1e-6].all() and not field.occupied[depth < -1e-6].any()
    assert field.occupied.any()


def test_gremlins_circle_once_in_two_pi_seconds() -> None:
    layout = sample_layout(parse_world("gremlin"), 5)
    assert layout.gremlin_positions(0.0) - layout.gremlins == pytest.approx(np.tile([GREMLIN_ORBIT, 0.0], (10, 1)))
    assert layout.gremlin_positions(np.pi / 2) - layout.gremlins == pytest.approx(
        np.tile([0.0, GREMLIN_ORBIT], (10, 1)), abs=1e-12
    )
    assert layout.gremlin_positions(2 * np.pi) == pytest.approx(layout.gremlin_positions(0.0))


@given(seeds, st.floats(0.0, 100.0))
@settings(max_examples=30)
def test_gremlins_never_come_near_start_goal_or_border(seed: int, time: float) -> None:
    layout = sample_layout(parse_world("gremlin"), seed)
    positions = layout.gremlin_positions(time)
    reach = GREMLIN_HALF_SIZE * math.sqrt(2.0)
    for place in (layout.start[:2], layout.goal):
        assert (np.linalg.norm(positions - place, axis=-1) - reach >= 0.4 - 1e-9).all()
    assert (np.abs(positions) + reach <= 2.0 + 1e-9).all()


def test_the_map_and_the_lidar_follow_the_gremlins() -> None:
    layout = sample_layout(parse_world("gremlin"), 5)
    for time in (0.0, 1.0, 4.0):
        positions = layout.gremlin_positions(time)
        assert layout.occupancy(time).occupied_at(positions).all()
        assert layout.obstacle_discs(time)[:, :2] == pytest.approx(positions)
        assert (layout.obstacle_discs(time)[:, 2] == 0.1).all()
    assert (layout.occupancy(0.0).occupied != layout.occupancy(np.pi).occupied).any()


def test_worlds_that_stand_still_keep_one_map() -> None:
    layout = sample_layout(parse_world("pillar(2,2,10)"), 5)
    assert layout.occupancy(0.0) is layout.occupancy(9.0)
    assert (layout.obstacle_discs(3.0)[:, :2] == layout.pillars).all()
    assert (layout.obstacle_discs(3.0)[:, 2] == 0.2).all()


@pytest.mark.parametrize("name", ["two-room", "four-room"])
def test_walls_are_seen_every_0_1_m_along_their_centre_line(name: str) -> None:
    layout = sample_layout(parse_world(name), 5)
    discs = layout.obstacle_discs(0.0)
    points, first = discs[:, :2], 0
    assert (discs[:, 2] == 0.05).all(), "half as thick as the wall"
    for wall in layout.walls:
        length = np.abs(wall[2:] - wall[:2]).max()
        count = math.ceil(length / 0.1 - 1e-9) + 1
        piece = points[first : first + count]
        assert piece[0] == pytest.approx(wall[:2]) and piece[-1] == pytest.approx(wall[2:])
        gaps = np.linalg.norm(np.diff(piece, axis=0), axis=-1)
        assert gaps.max() <= 0.1 + 1e-9 and gaps.min() > 0.07
        first += count
    assert first == len(points)


def test_the_border_belongs_to_the_field_and_nothing_beyond() -> None:
    layout = sample_layout(parse_world("pillar(2,1,3)"), 0)
    positions = [(2.0, -1.0), (2.001, 0.0), (0.0, -1.001), (0.0, 0.0), (np.nan, 0.0)]
    assert layout.in_field(np.array(positions)).tolist() == [True, False, False, True, False]


# maps from files


def test_a_map_file_is_a_world(map_path: str) -> None:
    spec = parse_world(f"map({map_path})")
    assert spec == parse_world(map_path) == parse_world(str(spec))
    assert (spec.kind, spec.half_width, spec.half_height, spec.max_steps) == ("map", 3.0, 2.0, 900)
    layout = sample_layout(spec, 0)
    assert layout.extent == pytest.approx((3.0, 9.0, 4.0, 8.0))
    assert layout.in_field(np.array([(3.1, 4.1), (2.9, 5.0), (0.0, 0.0)])).tolist() == [True, False, False]
    assert layout.occupancy(0.0) is layout.base_map


@given(seed=seeds)
@settings(max_examples=40)
def test_map_starts_and_goals_have_room_and_a_path(map_path: str, seed: int) -> None:
    layout = sample_layout(parse_world(map_path), seed, robot_radius=0.2)
    field = layout.occupancy(0.0)
    ends = np.stack((layout.start[:2], layout.goal))
    assert (field.clearance_at(ends) >= 0.4 - 1e-6).all()
    assert np.linalg.norm(ends[1] - ends[0]) >= 0.8
    assert is_solvable(field, ends[0], ends[1], 0.2)
    assert sample_layout(parse_world(map_path), seed, robot_radius=0.2).goal.tolist() == layout.goal.tolist()


def test_a_map_file_is_seen_by_its_surfaces(map_path: str) -> None:
    layout = sample_layout(parse_world(map_path), 0)
    points = layout.obstacle_discs(0.0)[:, :2]
    assert (layout.obstacle_discs(0.0)[:, 2] == 0.025).all(), "half a pixel"
    field = layout.occupancy(0.0)
    assert field.occupied_at(points).all()
    squares = np.floor((points - np.array(field.origin)) / 0.1 + 1e-9)
    assert len(np.unique(squares, axis=0)) == len(points)
    beside = points[:, None] + 0.05 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
    assert (~field.occupied_at(beside)).any(axis=1).all()
    # a robot anywhere in the hall sees every surface within 0.1 m of where it is
    row, col = np.nonzero(~field.occupied & (field.clearance < 0.03))
    surface = field.pixel_centers()[row, col]
    assert np.linalg.norm(surface[:, None] - points, axis=-1).min(axis=1).max() < 0.15


def write_corridor(folder: Path, rows: int) -> str:
    picture = np.pad(np.full((rows, 100), 254, np.uint8), 5)
    cv2.imwrite(str(folder / "corridor.png"), picture)
    (folder / "corridor.yaml").write_text(
        "image: corridor.png\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    )
    return str(folder / "corridor.yaml")


def test_in_a_narrow_map_the_robot_s_own_radius_must_do(tmp_path: Path) -> None:
    layout = sample_layout(parse_world(write_corridor(tmp_path, rows=10)), 0, robot_radius=0.15)
    ends = np.stack((layout.start[:2], layout.goal))
    clearance = layout.occupancy(0.0).clearance_at(ends)
    assert (clearance >= 0.15).all() and (clearance < 0.4).all()


def test_a_map_too_narrow_for_the_robot_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(WorldError, match=r"corridor\.yaml.*no place is free.*radius 0\.3 m"):
        sample_layout(parse_world(write_corridor(tmp_path, rows=10)), 0, robot_radius=0.3)
