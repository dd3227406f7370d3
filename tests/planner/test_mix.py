"""Claims about mixes of worlds: weights are shares, ranges are filled, and nonsense is refused by name."""

from __future__ import annotations

import numpy as np
import pytest

from hiernav.planner.mix import WorldMix, WorldRange
from hiernav.sim.layout import parse_world


def drawn(*texts: str, count: int = 400) -> list:
    mix, rng = WorldMix(texts), np.random.default_rng(0)
    return [mix.draw(rng) for _ in range(count)]


def test_a_world_without_ranges_is_that_world():
    assert set(drawn("pillar(2,2,10)")) == {parse_world("pillar(2,2,10)")}
    assert set(drawn("two-room")) == {parse_world("two-room")}


def test_weights_are_shares():
    kinds = [spec.kind for spec in drawn("3*gremlin", "two-room", "0.5 * four-room", count=2000)]
    shares = [kinds.count(kind) / 2000 for kind in ("gremlin", "two-room", "four-room")]
    np.testing.assert_allclose(shares, np.array([3.0, 1.0, 0.5]) / 4.5, atol=0.03)


def test_sizes_and_numbers_fill_their_ranges():
    specs = drawn("pillar(2..4,1.5..3,5..9)")
    for name, low, high in (("half_width", 2.0, 4.0), ("half_height", 1.5, 3.0), ("num_obstacles", 5, 9)):
        values = [getattr(spec, name) for spec in specs]
        assert low <= min(values) < low + 0.1 * (high - low) + 1e-9
        assert high - 0.1 * (high - low) - 1e-9 < max(values) <= high


def test_a_density_gives_every_field_its_share_of_obstacles():
    for spec in drawn("pillar(2..8,2..8,0.4..0.7/m2)", count=100):
        area = 4.0 * spec.half_width * spec.half_height
        assert 0.4 * area - 0.5 <= spec.num_obstacles <= 0.7 * area + 0.5
    extremes = WorldRange("pillar(2..8,2..8,0.4..0.7/m2)").extremes()
    assert [str(each) for each in extremes] == ["pillar(2,2,6)", "pillar(8,8,179)", "pillar(2,2,11)"]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("maze", "'maze'"),
        ("0*gremlin", "weight 0"),
        ("pillar(4..2,2,10)", "4..2 is empty; write 2..4"),
        ("pillar(2..x,2,10)", "'2..x', expected a number, a range"),
        ("pillar(2..3,2,10,5)", "4 arguments"),
        ("pillar(2..900,2,10)", "W = 900"),
        ("pillar(2/m2,2,10)", "a side is no density"),
        ("two-room(0.1..3,3)", "W = 0.1"),
    ],
)
def test_nonsense_is_refused_by_name(text: str, named: str):
    with pytest.raises(ValueError) as error:
        WorldRange(text)
    assert named in str(error.value) and "\n" not in str(error.value)
