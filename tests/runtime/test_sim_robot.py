from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hiernav.nav.observation import ObservationTerm
from hiernav.runtime.clock import FakeClock
from hiernav.runtime.noise import EXACT, SensorNoise
from hiernav.runtime.robot import VECTOR_SENSORS, CommandWatchdog
from hiernav.runtime.sim_robot import SimRobot
from hiernav.sim.layout import parse_world
from hiernav.sim.robots import ROBOTS, RobotSpec, get_robot
from hiernav.sim.worlds import sample_layout

LAYOUT = sample_layout(parse_world("pillar(2,2,4)"), seed=1)


def simulated(name: str = "point", **settings: object) -> SimRobot:
    return SimRobot(get_robot(name), LAYOUT, **settings)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_frame_has_every_sensor_of_the_robot(name):
    robot = simulated(name)
    frame = robot.read()
    terms = frame.terms()
    assert set(terms) == {*VECTOR_SENSORS, "lidar", *(term.name for term in robot.spec.own_terms)}
    assert all(terms[term.name].shape == (term.size,) for term in robot.spec.own_terms)
    assert terms["lidar"].shape == (10,) and terms["lidar"].max() > 0.0
    assert frame.position_fix.shape == (2,)


def test_a_sensor_of_the_model_is_observed_where_the_robot_says_so(tmp_path):
    model = tmp_path / "point.xml"
    text = get_robot("point").xml_path.read_text()
    text = text.replace("</body>", '<site name="down" pos="0.16 0 0" zaxis="0 0 -1"/></body>')
    model.write_text(text.replace("</sensor>", '<rangefinder name="ground" site="down" cutoff="1"/></sensor>'))

    class WithRange(RobotSpec):
        xml_path = model

    def robot(size: int) -> SimRobot:
        ground = ObservationTerm("ground", size, "m", 5.0)
        spec = WithRange("point", 2, 0.002, 0.1, 0.1, free_base=False, observed_sensors=(ground,))
        return SimRobot(spec, LAYOUT, EXACT)

    frame, layout = robot(1).read(), robot(1).spec.observation_layout()
    assert layout.sensors["ground"] == 1 and layout.size == get_robot("point").observation_layout().size + 1
    np.testing.assert_allclose(frame.extra["ground"], [0.1], atol=1e-6)  # of the body's origin above the floor
    with pytest.raises(ValueError, match="sensor 'ground' of .*point.xml has 1 value, 3 are observed"):
        robot(3)


def test_each_command_lets_one_control_period_pass():
    robot = simulated("car")
    for k in range(5):
        assert robot.read().stamp == pytest.approx(k * robot.control_period)
        robot.send(np.zeros(2))


def test_what_was_really_sent_is_returned():
    np.testing.assert_array_equal(simulated().send(np.array([3.0, -0.5])), [1.0, -0.5])


@pytest.mark.parametrize("action", [np.array([np.nan, 0.0]), np.zeros(3)])
def test_an_action_the_robot_cannot_take_is_refused(action):
    with pytest.raises(ValueError, match="SimRobot.send"):
        simulated().send(action)


def test_a_noisy_lidar_is_off_by_a_distance_and_sees_nothing_where_nothing_is():
    noisy, exact = simulated(noise=replace(EXACT, lidar=0.05)), simulated(noise=EXACT)
    errors = []
    for _ in range(200):
        seen, true = noisy.read().lidar, exact.read().lidar
        assert ((seen == 0.0) == (true == 0.0)).all() and seen.max() <= 1.0
        errors.append(np.log(true[true > 0.0]) - np.log(seen[true > 0.0]))
        noisy.brake()
        exact.brake()
    assert np.std(np.concatenate(errors)) == pytest.approx(0.05, rel=0.1)


def test_reading_twice_draws_no_new_noise():
    robot = simulated()
    assert robot.read() is robot.read()


def test_the_same_seed_gives_the_same_noise_and_another_seed_another():
    def readings(seed: int) -> np.ndarray:
        robot = simulated(seed=seed)
        values = []
        for _ in range(5):
            values.append(robot.read().gyro)
            robot.brake()
        return np.array(values)

    np.testing.assert_array_equal(readings(3), readings(3))
    assert (readings(3) != readings(4)).all()


def test_the_noise_has_the_size_that_was_asked_for():
    noise = SensorNoise(gyro=0.5, accelerometer=2.0, velocimeter=0.1, magnetometer=0.05, fix=0.3, fix_period=0.02)
    noisy, exact = simulated(noise=noise), simulated(noise=replace(EXACT, fix_period=0.02))
    errors: dict[str, list[np.ndarray]] = {}
    for _ in range(400):
        seen, true = noisy.read(), exact.read()
        for name in (*VECTOR_SENSORS, "position_fix"):
            errors.setdefault(name, []).append(getattr(seen, name) - getattr(true, name))
        noisy.brake(), exact.brake()
    for name, sigma in zip((*VECTOR_SENSORS, "position_fix"), (2.0, 0.5, 0.05, 0.1, 0.3), strict=True):
        assert np.std(errors[name]) == pytest.approx(sigma, rel=0.15)


def test_fixes_come_at_their_own_rate_and_late_by_their_latency():
    robot = simulated(noise=SensorNoise(fix_latency=0.06))
    stamps, delays = [], []
    for _ in range(100):
        frame = robot.read()
        if frame.position_fix is not None:
            stamps.append(frame.fix_stamp)
            delays.append(frame.stamp - frame.fix_stamp)
        robot.brake()
    np.testing.assert_allclose(np.diff(stamps), 0.1, atol=1e-9)
    np.testing.assert_allclose(delays, 0.06, atol=1e-9)
    assert len(stamps) == 20


def test_a_late_fix_says_where_the_robot_was():
    robot = simulated(noise=replace(EXACT, fix_latency=0.06))
    track = {}
    for _ in range(60):
        frame, truth = robot.read(), robot.truth()
        track[round(frame.stamp, 6)] = truth.pose[:2]
        if frame.position_fix is not None:
            np.testing.assert_allclose(frame.position_fix, track[round(frame.fix_stamp, 6)])
        robot.send(np.array([1.0, 0.3]))


def test_lost_readings_are_missing_and_not_zero():
    robot = simulated(noise=SensorNoise(dropout=0.5, fix_dropout=1.0))
    lost = 0
    for _ in range(50):
        frame = robot.read()
        lost += sum(getattr(frame, name) is None for name in VECTOR_SENSORS)
        assert frame.position_fix is None
        robot.brake()
    assert 50 < lost < 150


def test_truth_counts_control_steps_with_contact():
    pillar = LAYOUT.pillars[0]
    start = np.array([pillar[0] - 0.45, pillar[1], 0.0])
    robot = SimRobot(get_robot("point"), replace(LAYOUT, start=start))
    for _ in range(100):
        robot.send(np.array([1.0, 0.0]))
    assert robot.truth().collisions > 0
    robot.reset(LAYOUT)
    assert robot.truth().collisions == 0


def test_missed_periods_pass_under_the_last_command_and_then_braked():
    clock = FakeClock()
    robot = simulated(clock=clock, noise=EXACT)
    followed, braked = simulated(noise=EXACT), simulated(noise=EXACT)
    push = np.array([1.0, 0.0])
    robot.send(push)
    clock.advance(5 * robot.control_period)
    frame = robot.read()
    assert frame.stamp == pytest.approx(5 * robot.control_period)
    assert robot.watchdog.trips == 1
    # 50 ms are two and a half periods of the point robot: two more under the command, the rest braked
    for k in range(5):
        followed.send(push)
        braked.send(push if k < 3 else np.zeros(2))
    np.testing.assert_array_equal(robot.truth().pose, braked.truth().pose)
    assert (robot.truth().pose != followed.truth().pose).any()


def test_a_command_that_is_merely_late_is_not_a_missed_one():
    clock = FakeClock()
    robot = simulated(clock=clock)
    for k in range(20):
        assert robot.read().stamp == pytest.approx(k * robot.control_period)
        robot.send(np.zeros(2))
        clock.advance(robot.control_period * (1.4 if k % 2 else 0.6))
    assert robot.watchdog.trips == 0


def test_a_watchdog_trips_once_for_each_silence():
    watchdog = CommandWatchdog(control_period=0.02)
    assert watchdog.expired(0.0)
    watchdog.feed(1.0)
    assert not watchdog.expired(1.0499)
    assert watchdog.expired(1.0501) and watchdog.expired(2.0)
    watchdog.feed(3.0)
    assert not watchdog.expired(3.0)
    assert watchdog.trips == 1


def test_a_slow_robot_is_given_time_for_its_own_period():
    assert CommandWatchdog(control_period=0.1).timeout == pytest.approx(0.15)


@pytest.mark.parametrize("settings", [{"gyro": -1.0}, {"dropout": 1.5}, {"fix_period": 0.0}, {"fix": float("nan")}])
def test_noise_that_makes_no_sense_is_refused(settings):
    with pytest.raises(ValueError, match="SensorNoise"):
        SensorNoise(**settings)
