"""Claims about the planner's labelled samples: what the network is shown, and what it is taught."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from hiernav.nav import goselo
from hiernav.nav.occupancy import OccupancyMap, nearest_pixel
from hiernav.nav.search import PathField
from hiernav.planner import dataset
from hiernav.planner.dataset import LabelSettings, Samples, label_world, make_samples, map_tasks
from hiernav.run import WorkersLost
from hiernav.sim.layout import Layout, parse_world
from hiernav.sim.worlds import WorldError, sample_layout

RADIUS = 0.1
SETTINGS = LabelSettings(worlds=("pillar(1.5,1.5,5)",), radius=RADIUS, soft_margin=0.1, samples_per_world=8)
SPEC = parse_world(SETTINGS.worlds[0])


@dataclass
class Drawn:
    """Samples with what they were made from, in the world frame [m]."""

    samples: Samples
    occupancy: list[OccupancyMap] = field(default_factory=list)
    goal: list[np.ndarray] = field(default_factory=list)
    start: list[np.ndarray] = field(default_factory=list)
    label: list[np.ndarray] = field(default_factory=list)


def draw(settings: LabelSettings, count: int = 40) -> Drawn:
    """Make samples and note every start that became one."""
    drawn = Drawn(None)  # type: ignore[arg-type]
    label = dataset._label

    def noting(path_field, start, *rest):
        found = label(path_field, start, *rest)
        if found is not None:
            drawn.occupancy.append(path_field.occupancy)
            drawn.goal.append(path_field.goal)
            drawn.start.append(np.array(start))
            drawn.label.append(found)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "_label", noting)
        drawn.samples = make_samples(settings, count, (3,))
    return drawn


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    return draw(SETTINGS)


@pytest.fixture(scope="module")
def paper() -> Drawn:
    return draw(replace(SETTINGS, random_smoothing=True, soft_margin=0.0, channels=goselo.CHANNELS))


def same(a: Samples, b: Samples) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Samples.__dataclass_fields__)


def test_samples_depend_on_the_seed_and_not_on_the_number_of_processes():
    settings = replace(SETTINGS, samples_per_world=3)  # ten worlds: more than one process takes at a time
    alone = make_samples(settings, 30, (7, 1), processes=1)
    assert same(alone, make_samples(settings, 30, (7, 1), processes=2))
    assert not same(alone, make_samples(settings, 30, (7, 2), processes=1))


def test_a_process_that_is_killed_while_it_makes_samples_is_told_in_one_line():
    with pytest.raises(WorkersLost, match=r"^one of 2 processes that make samples died, [^\n]*with fewer threads$"):
        list(map_tasks(os._exit, [(9,), (9,)], 2))


def test_worlds_are_drawn_from_the_whole_mix_and_each_has_a_seed_of_its_own(monkeypatch):
    drawn = []

    def noting(settings, spec, seed, count):
        drawn.append((spec.kind, seed))
        return Samples.empty(settings, count)

    monkeypatch.setattr(dataset, "label_world", noting)
    make_samples(replace(SETTINGS, worlds=("3*pillar(1.5,1.5,5)", "two-room"), samples_per_world=1), 60, (0,))
    kinds, seeds = zip(*drawn, strict=True)
    assert kinds.count("pillar") + kinds.count("two-room") == 60 and 5 < kinds.count("two-room") < 30
    assert len(set(seeds)) == 60


def test_labels_are_of_shortest_paths_with_the_radius_and_the_margin_of_their_settings(monkeypatch):
    fields = []

    class Noted(PathField):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            fields.append((self.radius, self.soft_margin))

    monkeypatch.setattr(dataset, "PathField", Noted)
    make_samples(replace(SETTINGS, radius=0.12, soft_margin=0.07, samples_per_world=1), 2, (0,))
    assert fields == [(0.12, 0.07)] * 2


def test_a_count_that_is_no_multiple_of_the_samples_per_world_is_met():
    reported: list[int] = []
    samples = make_samples(SETTINGS, 11, (0,), on_progress=reported.append)
    assert len(samples) == 11
    assert reported[-1] == 11
    assert np.isfinite(samples.label).all() and (samples.distance > 0).all()
    assert all(image.any() for image in samples.image)


def test_shapes_and_types_are_what_the_network_takes(drawn, paper):
    for each, channels in ((drawn.samples, 4), (paper.samples, 7)):
        assert each.image.shape == (40, channels, 64, 64) and each.image.dtype == np.uint8
        assert each.clearance.shape == (40, 64, 64) and each.clearance.dtype == np.uint8
        assert each.distance.shape == (40,) and each.distance.dtype == np.float32
        assert each.label.shape == (40, 10, 2) and each.label.dtype == np.float32


def test_the_goal_lies_straight_above_the_robot_at_distance_l(drawn):
    start, goal = np.array(drawn.start), np.array(drawn.goal)
    length = np.maximum(np.linalg.norm(goal - start, axis=-1), goselo.MIN_DISTANCE)
    np.testing.assert_allclose(drawn.samples.distance, length, rtol=1e-6)
    up = (goal - start) / np.linalg.norm(goal - start, axis=-1, keepdims=True)
    right = np.stack([up[:, 1], -up[:, 0]], axis=-1)
    delta = np.array(drawn.label) - start[:, None]
    in_frame = np.stack([(delta * right[:, None]).sum(-1), (delta * up[:, None]).sum(-1)], axis=-1)
    np.testing.assert_allclose(drawn.samples.label, in_frame, atol=1e-6)


@pytest.mark.parametrize("kind", ["drawn", "paper"])
def test_waypoints_are_a_tenth_of_a_metre_apart_and_end_in_the_goal(kind, request):
    made: Drawn = request.getfixturevalue(kind)
    samples, goal_distance = made.samples, np.linalg.norm(np.array(made.goal) - np.array(made.start), axis=-1)
    line = np.concatenate([np.zeros((40, 1, 2)), samples.label], axis=1)
    steps = np.linalg.norm(np.diff(line, axis=1), axis=-1)
    goal = np.stack([np.zeros(40), goal_distance], axis=-1)
    at_goal = np.linalg.norm(samples.label - goal[:, None], axis=-1) < 1e-5
    assert steps.max() <= 0.1 + 1e-5
    # on the way: arc length 0.1 m, so less only across a bend
    on_the_way = steps[~at_goal]
    assert (on_the_way > 0.06).all() and np.median(on_the_way) > 0.0999
    # once there, always there; and the samples hold starts from which ten waypoints get there
    assert (np.diff(at_goal.astype(int), axis=1) >= 0).all()
    assert 0 < at_goal[:, -1].sum() < 40
    assert at_goal[goal_distance < 0.6, -1].mean() > 0.5 and not at_goal[goal_distance > 1.0, -1].any()


def test_labels_lead_through_free_space_and_away_from_obstacles(drawn):
    start = np.array([float(m.clearance_at(p)) for m, p in zip(drawn.occupancy, drawn.start, strict=True)])
    clearance = np.array([m.clearance_at(p) for m, p in zip(drawn.occupancy, drawn.label, strict=True)])
    assert (start < RADIUS).any() and (start > RADIUS).any()
    assert start.min() > 0.0
    # 2 cm: lines are checked every 5 cm, and a start lies up to half a cell off its cell's centre
    assert (clearance[start > RADIUS] > RADIUS - 0.02).all()
    # a robot in contact is led out within its first waypoints
    assert (clearance[:, 2:] > RADIUS - 0.02).all()


def test_half_of_the_starts_have_been_driven_to_and_show_it(paper):
    visits = paper.samples.image[:, 3:6]
    order = np.arange(40) % 2 == 1
    # how much of a crop is lit, in pixels that a robot came into once
    driven = visits[:, 2].sum(axis=(1, 2)) * (4.0 * paper.samples.distance / 64 / 0.05) ** 2 / 63.0
    assert (driven[~order] < 2.0).all(), "only where they stand"
    # the way there ends near the robot, half of L below the centre: 16 pixels of the crop of side 4 L are L
    far = order & (paper.samples.distance > 0.8)
    near = visits[far, 2, 32:48, 24:40]
    assert far.sum() >= 5  # they stand all along the way, not mostly at its end
    assert near.any(axis=(1, 2)).all()
    assert np.median(driven[far]) > 5.0


def test_every_start_is_among_the_visits_as_it_is_when_a_robot_plans(monkeypatch):
    """What `WaypointOption` does first: enter the pixel that the robot stands in."""
    shown = []
    images = goselo.images

    def noting(occupancy, visits, frame, channels):
        shown.extend(zip(visits, frame.position, strict=True))
        return images(occupancy, visits, frame, channels)

    monkeypatch.setattr(goselo, "images", noting)
    paper = replace(SETTINGS, random_smoothing=True, soft_margin=0.0, channels=goselo.CHANNELS)
    make_samples(paper, 16, (3,))
    assert len(shown) == 16
    for seen, start in shown:
        assert seen.counts[nearest_pixel(start, seen.counts.shape, seen.resolution, seen.origin)] >= 1
        before = seen.counts.copy()
        seen.add(start)
        assert np.array_equal(seen.counts, before), "the robot is there"
    assert [int(seen.counts.sum()) for seen, _ in shown[::2]] == [1] * 8
    assert np.median([int(seen.counts.sum()) for seen, _ in shown[1::2]]) > 2


def test_a_world_whose_goal_hardly_a_path_leads_to_is_an_error_and_no_endless_search(monkeypatch):
    layout = sample_layout(SPEC, 5, 0.1)
    monkeypatch.setattr(dataset, "sample_layout", lambda *_: layout)
    wide = replace(SETTINGS, radius=1.5)
    with pytest.raises(WorldError, match=r"seed 5: 0 of 400 starts have a path to the goal .* for a disc of 1.5 m"):
        label_world(wide, SPEC, 5, 2)


def test_labels_avoid_the_same_obstacles_that_the_images_show(drawn):
    images, label = drawn.samples.image, drawn.samples.label
    local = images[:, goselo.METRIC_CHANNELS.index("clearance_local")]
    np.testing.assert_array_equal(local, drawn.samples.clearance)
    column = np.floor((label[..., 0] / goselo.LOCAL_SIDE + 0.5) * 64).astype(int)
    row = np.floor((0.5 - label[..., 1] / goselo.LOCAL_SIDE) * 64).astype(int)
    shown = local[np.arange(40)[:, None], row, column] / 255.0 * goselo.CLEARANCE_CLIP
    free = np.array([m.clearance_at(p) for m, p in zip(drawn.occupancy, drawn.label, strict=True)])
    np.testing.assert_allclose(shown, np.minimum(free, goselo.CLEARANCE_CLIP), atol=0.05)
    # the pixels of another sample do not fit: the claim above is about these pictures
    other = np.roll(local, 1, axis=0)[np.arange(40)[:, None], row, column] / 255.0 * goselo.CLEARANCE_CLIP
    assert np.abs(other - np.minimum(free, goselo.CLEARANCE_CLIP)).max() > 0.3


def mirrored(layout: Layout) -> Layout:
    flip = np.array([-1.0, 1.0])
    start = layout.start * [-1.0, 1.0, -1.0] + [0.0, 0.0, np.pi]
    return replace(layout, pillars=layout.pillars * flip, start=start, goal=layout.goal * flip)


def test_a_mirrored_world_gives_mirrored_samples(monkeypatch):
    layout = sample_layout(SPEC, 5, RADIUS)
    occupancy, rng = layout.occupancy(0.0), np.random.default_rng(0)
    starts = [dataset._random_start(occupancy, rng) for _ in range(24)]

    def samples_of(world: Layout, positions: list[np.ndarray]) -> Samples:
        monkeypatch.setattr(dataset, "sample_layout", lambda *_: world)
        parts = []
        for position in positions:
            monkeypatch.setattr(dataset, "_random_start", lambda *_, here=position: here)
            parts.append(label_world(SETTINGS, SPEC, 5, 1))
        return Samples(*(np.concatenate([getattr(p, name) for p in parts]) for name in Samples.__dataclass_fields__))

    ours = samples_of(layout, starts)
    theirs = samples_of(mirrored(layout), [start * [-1.0, 1.0] for start in starts])
    np.testing.assert_allclose(ours.distance, theirs.distance, rtol=1e-6)
    # resampling rounds differently by a grey level or two, and a pixel on an edge now and then falls to the other side
    apart = np.abs(ours.image.astype(int) - theirs.image[..., ::-1].astype(int))
    assert np.mean(apart > 8) < 0.01
    # where two ways are as short as each other the grid decides; everywhere else the labels are mirror images
    error = np.linalg.norm(ours.label - theirs.label * [-1.0, 1.0], axis=-1).max(axis=1)
    assert np.mean(error < 0.08) > 0.8
