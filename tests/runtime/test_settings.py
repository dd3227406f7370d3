"""Claims about the runtime's settings: strict, by section, and those that ship can be read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import is_dataclass
from pathlib import Path
from typing import get_args, get_origin, get_type_hints

import pytest
from shipped import ROOT

from hiernav.decode import ConfigError
from hiernav.runtime.settings import Settings, differing, load_settings


@pytest.mark.parametrize("robot", ["point", "car", "doggo"])
def test_the_settings_that_ship_can_be_read(robot):
    settings = load_settings([ROOT / "deploy" / f"{robot}.yaml"])
    assert settings != Settings()


def test_the_command_line_goes_over_the_file_and_the_file_over_the_robot(tmp_path: Path):
    file = tmp_path / "s.yaml"
    file.write_text("guard: {slow_ttc: 0.5}\ndriver: {max_steps: 7}\n")
    asked = {"driver": {"max_steps": 3, "robot_radius": 0.2}}
    settings = load_settings([file], ["guard.slow_ttc=0.7", "realtime.cpus=[0, 1]"], asked)
    assert (settings.guard.slow_ttc, settings.driver.max_steps, settings.driver.robot_radius) == (0.7, 7, 0.2)
    assert settings.realtime.cpus == (0, 1)


def test_a_file_goes_over_those_before_it_and_is_blamed_for_what_it_says(tmp_path: Path):
    """Whoever adds a setting of his own must not lose the limits that ship with the robot."""
    own = tmp_path / "own.yaml"
    own.write_text("estimator: {gyro_sigma: 0.05}\nguard: {slew_limit: 0.3}\n")
    shipped = ROOT / "deploy" / "doggo.yaml"
    settings = load_settings([shipped, own])
    assert settings.estimator.gyro_sigma == 0.05 and settings.guard.slew_limit == 0.3
    assert settings.guard.tilt_limit == load_settings([shipped]).guard.tilt_limit == 1.31
    own.write_text("guard: {slew_limit: -1}\n")
    with pytest.raises(ConfigError, match=r"own.yaml: guard: .*slew_limit = -1"):
        load_settings([shipped, own])
    with pytest.raises(ConfigError, match=r"own.yaml: guard: .*slew_limit = -1"):
        load_settings([own, shipped])


@pytest.mark.parametrize(
    ("override", "why"),
    [
        ("guard.slow_tcc=1", "did you mean 'slow_ttc'"),
        ("gard.slow_ttc=1", "did you mean 'guard'"),
        ("guard.slow_ttc=-1", "must be finite and positive"),
        ("guard.slow_ttc=.nan", "must be finite and positive"),
        ("driver.max_steps=many", "Expected `int`"),
        ("driver.max_steps=0", "max_steps = 0 must be finite and positive"),
        ("realtime.fifo_priority=0", "fifo_priority = 0 must be 1 to 98"),
        ("realtime.fifo_priority=99", "fifo_priority = 99 must be 1 to 98"),
        ("realtime.cpus=[]", "at least one"),
        ("realtime.cpus=[0, -1]", "cpus = [0, -1] must be numbers of CPUs from 0"),
        ("realtime.timer_slack_ns=-1", "timer_slack_ns = -1 ns must not be negative"),
        ("realtime.wake_latency_us=-1", "wake_latency_us = -1 us must not be negative"),
        ("guard.tilt_limit=1.571", "tilt_limit = 1.571 rad must be in (0, pi/2)"),
        ("guard.max_tilted=21", "max_tilted = 21 must be from 1 to 20"),
        ("guard.max_non_finite=1000000000", "max_non_finite = 1000000000 must be from 1 to 20"),
        ("driver.stop_speed=1.1", "stop_speed = 1.1 must be at most 1"),
        ("driver.stop_timeout=1.0e+12", "stop_timeout = 1000000000000.0 must be at most 30"),
        ("driver.hold_timeout=601", "hold_timeout = 601.0 must be at most 600"),
        ("driver.plan_hold=11", "plan_hold = 11.0 must be at most 10"),
        ("estimator.lost_after=10.1", "lost_after = 10.1 must be at most 10"),
        ("estimator.fix_lost_after=61", "fix_lost_after = 61.0 must be at most 60"),
        ("driver=1", "expected section.key=value"),
        ("driver.max_steps", "expected section.key=value"),
    ],
)
def test_what_is_not_a_setting_is_refused_with_its_name(override, why):
    with pytest.raises(ConfigError) as refused:
        load_settings([], [override])
    assert why in str(refused.value)


def test_what_is_not_the_default_is_told_wherever_it_comes_from():
    assert differing(Settings()) == {}
    settings = load_settings([ROOT / "deploy" / "doggo.yaml"], ["driver.stop_speed=0.2"], {"driver": {"max_steps": 7}})
    assert differing(settings) == {"guard.tilt_limit": 1.31, "driver.stop_speed": 0.2, "driver.max_steps": 7}


def places(section: str = "", kind: object = Settings) -> Iterator[tuple[str, int | None]]:
    """Every setting that is a number with a fraction, and the length of those that are several."""
    for name, each in get_type_hints(kind).items():
        if is_dataclass(each):
            yield from places(name, each)
        elif get_origin(each) is tuple and float in get_args(each):
            yield f"{section}.{name}", len(get_args(each))
        elif each is float or float in get_args(each):
            yield f"{section}.{name}", None


PLACES = dict(places())


def test_the_places_of_numbers_are_found():
    assert PLACES["estimator.magnetic_field"] == PLACES["noise.gyro_bias"] == 3
    assert {"realtime.rehearsal", "guard.slow_ttc", "driver.goal_radius"} <= PLACES.keys()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("place", PLACES)
def test_what_is_not_finite_is_refused_wherever_it_stands_with_key_and_value(tmp_path: Path, place: str, value: float):
    section, _, key = place.partition(".")
    length, text = PLACES[place], f".{value}".replace(".-", "-.")
    for at in range(length or 1):
        given = text if length is None else str(["0.1"] * at + [text] + ["0.1"] * (length - at - 1)).replace("'", "")
        with pytest.raises(ConfigError) as refused:
            load_settings([], [f"{place}={given}"])
        said = str(refused.value)
        assert said.startswith(f"command line: {place}: ") and str(value) in said
        file = tmp_path / "s.yaml"
        file.write_text(f"{section}: {{{key}: {given}}}\n")
        with pytest.raises(ConfigError, match=rf"s\.yaml: {section}: .*{value}"):
            load_settings([file])


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("guard.slow_ttc=.nan", "command line: guard.slow_ttc: "),
        ("guard.slow_tcc=1", "command line: guard: unknown setting 'slow_tcc'"),
        ("driver.max_steps=many", "command line: driver.max_steps: Expected `int`"),
    ],
)
def test_what_the_command_line_got_wrong_is_not_blamed_on_the_file(tmp_path: Path, override: str, says: str):
    file = tmp_path / "s.yaml"
    file.write_text("guard: {tilt_limit: 0.5}\n")
    with pytest.raises(ConfigError) as refused:
        load_settings([file], ["guard.slew_limit=0.3", override])
    assert str(refused.value).startswith(says)


def test_what_the_file_got_wrong_is_not_blamed_on_the_command_line(tmp_path: Path):
    file = tmp_path / "s.yaml"
    file.write_text("guard: {slow_ttc: -1}\n")
    with pytest.raises(ConfigError, match=r"s\.yaml: guard: "):
        load_settings([file], ["guard.slew_limit=0.3"])
    assert load_settings([file], ["guard.slow_ttc=0.5"]).guard.slow_ttc == 0.5


@pytest.mark.parametrize("text", ["- 1", "guard: 3", "guard: [1]", "nothing: {}", "guard: {low: x}"])
def test_a_malformed_file_is_refused_with_its_name(tmp_path: Path, text: str):
    file = tmp_path / "s.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=r"s\.yaml"):
        load_settings([file])
