"""Claims about the waypoint networks: sizes, plans that are plans, and rows that do not meddle with each other."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")

from hiernav.nav import goselo  # noqa: E402
from hiernav.planner.network import HypothesisNetwork, PaperNetwork, TorchNetwork, make_network  # noqa: E402

pytestmark = pytest.mark.train


def inputs(rows: int, channels: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (rows, channels, 64, 64), dtype=np.uint8)
    return image, rng.uniform(0.2, 3.0, rows).astype(np.float32)


@pytest.fixture
def network() -> HypothesisNetwork:
    torch.manual_seed(1)
    return HypothesisNetwork(hypotheses=3)


def test_the_paper_network_has_the_published_number_of_parameters():
    assert sum(p.numel() for p in PaperNetwork().parameters()) == 78_964
    assert PaperNetwork.channels == goselo.CHANNELS and len(goselo.CHANNELS) == 6


@pytest.mark.parametrize(("preset", "hypotheses"), [("paper", 1), ("default", 3)])
@pytest.mark.parametrize("waypoints", [10, 5])
def test_a_plan_has_the_configured_number_of_waypoints(preset, hypotheses, waypoints):
    made = make_network(preset, waypoints, 0.1, 3)
    plans, scores = TorchNetwork(made)(*inputs(4, len(made.channels)))
    assert plans.shape == (4, hypotheses, waypoints, 2) and plans.dtype == np.float32
    assert scores.shape == (4, hypotheses) and scores.dtype == np.float32


def test_scores_are_probabilities_of_the_hypotheses(network):
    _, scores = TorchNetwork(network)(*inputs(5, 4))
    np.testing.assert_allclose(np.exp(scores).sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("spacing", [0.1, 0.25])
def test_waypoints_are_one_spacing_apart_until_the_goal(spacing):
    torch.manual_seed(0)
    image, _ = inputs(6, 4)
    far = np.full(6, 50.0, np.float32)
    plans, _ = TorchNetwork(HypothesisNetwork(spacing=spacing, hypotheses=2))(image, far)
    line = np.concatenate([np.zeros((6, 2, 1, 2)), plans], axis=2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(line, axis=2), axis=-1), spacing, rtol=1e-3)


def test_a_plan_that_comes_within_a_spacing_of_the_goal_ends_in_it(network):
    up = torch.zeros(3, 1, 10, 2)
    up[..., 1] = 0.1 * torch.arange(1, 11)
    up[1, ..., 0] = 0.15  # passes the goal on the right
    plans = network._stop_at_goal(up, torch.tensor([0.45, 0.45, 5.0]))
    torch.testing.assert_close(plans[0, 0, :3], up[0, 0, :3])
    torch.testing.assert_close(plans[0, 0, 3:], torch.tensor([0.0, 0.45]).expand(7, 2))
    torch.testing.assert_close(plans[1], up[1])
    torch.testing.assert_close(plans[2], up[2])


@pytest.mark.parametrize("preset", ["paper", "default"])
def test_a_row_gets_the_same_plan_alone_and_among_others(preset):
    torch.manual_seed(2)
    made = make_network(preset, 10, 0.1, 2)
    run, (image, distance) = TorchNetwork(made), inputs(9, len(made.channels))
    plans, scores = run(image, distance)
    for row in (0, 4, 8):
        alone, score = run(image[row : row + 1], distance[row : row + 1])
        np.testing.assert_allclose(alone[0], plans[row], atol=1e-5)
        np.testing.assert_allclose(score[0], scores[row], atol=1e-5)
    other = image.copy()
    other[5] = 255 - other[5]
    changed, _ = run(other, distance)
    apart = np.abs(changed - plans).max(axis=(1, 2, 3))
    assert apart[5] > 1e-4 and (np.delete(apart, 5) < 1e-5).all()


def test_the_default_network_knows_where_an_obstacle_is_and_the_papers_hardly_does():
    """Moving a pillar to the other side of the way hardly changes the pooled features of the paper's network."""
    torch.manual_seed(0)
    paper, ours = PaperNetwork().eval(), HypothesisNetwork(hypotheses=1).eval()

    def features(made, image):
        with torch.no_grad():
            if made is paper:
                return made.features(image / 255.0).mean(dim=(2, 3))
            return made.overview(image[:, :3] / 255.0)

    image = torch.zeros(2, 6, 64, 64)
    image[0, :3, 24:32, 20:28] = 255.0
    image[1, :3, 24:32, 36:44] = 255.0
    moved = {
        made: float((values[0] - values[1]).norm() / values[0].norm())
        for made in (paper, ours)
        for values in [features(made, image[:, : len(made.channels)])]
    }
    assert moved[paper] < 0.01 < 0.05 < moved[ours]


def test_the_distance_to_the_goal_is_an_input_of_the_default_network(network):
    image, _ = inputs(1, 4)
    run = TorchNetwork(network)
    near, _ = run(image, np.array([1.5], np.float32))
    far, _ = run(image, np.array([4.0], np.float32))
    assert np.abs(near - far).max() > 1e-4
