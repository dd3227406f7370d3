from __future__ import annotations

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from recorded_drive import BUNDLE, Operator, about, drive, serve

from hiernav import cli
from hiernav.nav.bundle import Bundle, load_bundle
from hiernav.nav.occupancy import VisitMap, empty_map
from hiernav.nav.option import PlanQuery
from hiernav.nav.recovery import Recovery
from hiernav.runtime import messages
from hiernav.runtime.log_reader import LogError, RunLog
from hiernav.runtime.noise import SensorNoise
from hiernav.runtime.observe import Observer, TickRecord
from hiernav.runtime.policy import OnnxSkill
from hiernav.runtime.recorder import Recorder
from hiernav.runtime.replay import ASKED, Replay, _Asked, _Recorded, _same, _texts
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode


def recorded(path, *runs, change=lambda record: record):
    """A recording of several runs, each given as keywords of `drive`."""
    recorder = Recorder(path, about(late=any("delay" in run for run in runs)).metadata())

    class Changed(Observer):
        def tick(self, record):
            recorder.tick(change(record))

        event = recorder.event

    for run in runs:
        drive(Changed(), **run)
    recorder.close()
    return RunLog(path)


@pytest.fixture(scope="module")
def bundle():
    return load_bundle(BUNDLE)


def test_everything_that_was_decided_is_decided_again_bit_for_bit(tmp_path, bundle):
    noisy = SensorNoise(dropout=0.1, fix_dropout=0.2, fix_latency=0.06)
    log = recorded(tmp_path / "run.mcap", {"seed": 1}, {"seed": 2, "world": "gremlin"}, {"seed": 3, "noise": noisy})
    replay = Replay(log, bundle)
    result = replay.compare()
    assert result.equal and result.complete and replay.same_policies, result.difference
    assert result.ticks == sum(1 for _ in log.ticks())
    assert result.compared["estimate"] == result.ticks
    assert result.compared["proposed"] == result.compared["plan"] > 150
    assert result.compared["sent"] > 150


@pytest.mark.parametrize("delay", [0.03, 0.25])
def test_plans_that_came_late_are_made_again_from_what_was_asked(tmp_path, bundle, delay):
    runs = [{"seed": 1, "delay": delay}, {"seed": 2, "world": "gremlin", "delay": delay}]
    log = recorded(tmp_path / "late.mcap", *runs)
    late = [tick for tick in log.ticks() if tick.replanned and tick.plan_stamp < tick.estimate.stamp]
    result = Replay(log, bundle).compare()
    assert result.equal and len(late) >= 10 and result.compared["plan"] > 100 + len(late), result.difference
    wrong = recorded(
        tmp_path / "wrong.mcap",
        runs[0],
        change=lambda r: replace(r, plan=r.plan + 1e-15) if r.replanned and r.index == late[3].index else r,
    )
    difference = Replay(wrong, bundle).compare().difference
    assert difference is not None and (difference.tick, difference.value) == (late[3].index, "plan")


def test_a_recording_says_whether_maps_were_predicted(tmp_path, bundle):
    """One that does not say so is from before that; where it matters the plans then differ."""
    log = recorded(tmp_path / "run.mcap", {"seed": 2, "world": "gremlin"})
    assert log.about["predict"] == "true"
    assert Replay(log, bundle).compare().equal
    log.about.pop("predict")
    result = Replay(log, bundle).compare()
    assert result.difference is not None and result.difference.tick > 15


def test_waiting_and_recovering_are_replayed_too(tmp_path, bundle):
    def blink(frame):
        return SensorFrame(frame.stamp, lidar=frame.lidar) if 0.5 < frame.stamp < 0.9 else frame

    log = recorded(tmp_path / "hard.mcap", {"seed": 1, "damage": blink}, {"seed": 4, "pinned_from": 0.6})
    modes = {tick.mode for tick in log.ticks()}
    assert {Mode.HOLD, Mode.RECOVERING} <= modes
    result = Replay(log, bundle).compare()
    assert result.equal, result.difference
    assert result.compared["sent"] > 150


def test_sensors_that_lie_fall_silent_or_speak_late_are_replayed_too(tmp_path, bundle):
    rng = np.random.default_rng(0)

    def damage(frame):
        if frame.stamp < 0.05 or 0.3 < frame.stamp < 0.6:
            frame = replace(frame, lidar=None)
        if 0.8 < frame.stamp < 1.2:
            frame = replace(frame, velocimeter=rng.uniform(-40.0, 40.0, 3))
        return frame if frame.fix_stamp is None else replace(frame, fix_stamp=frame.fix_stamp + 0.001)

    log = recorded(tmp_path / "lies.mcap", {"seed": 1, "damage": damage})
    held = {tick.estimate.why.split()[0] for tick in log.ticks() if tick.estimate is not None and tick.estimate.why}
    assert held == {"position_fix:", "lidar", "velocimeter"}
    result = Replay(log, bundle).compare()
    assert result.equal and result.compared["sent"] > 50, result.difference


def test_a_clock_that_starts_again_and_a_stamp_far_ahead_are_replayed_too(tmp_path, bundle):
    def other_time(frame):
        ahead = 1e9 if 0.49 < frame.stamp < 0.51 else 50.0 if frame.stamp < 0.7 else -0.7
        fix_stamp = None if frame.fix_stamp is None else frame.fix_stamp + ahead
        return replace(frame, stamp=frame.stamp + ahead, fix_stamp=fix_stamp)

    log = recorded(tmp_path / "restart.mcap", {"seed": 1, "damage": other_time}, {"seed": 2})
    estimates = [tick.estimate for tick in log.ticks()]
    assert None in estimates[20:] and len({estimate.restarts for estimate in estimates if estimate is not None}) > 1
    result = Replay(log, bundle).compare()
    assert result.equal, result.difference
    assert result.compared["sent"] > 150


def served(path, operator, **hindrances):
    """A recording of a loop that serves."""
    recorder = Recorder(path, about().metadata())
    serve(operator, recorder, **hindrances)
    recorder.close()
    return RunLog(path)


def test_a_drive_after_a_tick_that_failed_is_replayed_too(tmp_path, bundle):
    """The estimator has taken its frame, and the skill decided; then the command was not taken."""

    def command(operator, tick, record):
        if record.mode is Mode.FAULT:
            operator.driver.acknowledge()
        if tick == 3 or record.mode is Mode.FAULT:
            operator.driver.set_goal(operator.goal)

    log = served(tmp_path / "failed.mcap", Operator(200, command), fails_at=20)
    ticks = list(log.ticks())
    assert [tick.index for tick in ticks] == list(range(len(ticks)))
    (failed,) = (tick for tick in ticks if tick.mode is Mode.FAULT)
    assert failed.proposed is not None and failed.sent is None
    assert sum(tick.sent is not None for tick in ticks[failed.index :]) > 20
    result = Replay(log, bundle).compare()
    assert result.equal and result.ticks == len(ticks), result.difference


@pytest.mark.parametrize("last", [0, 5])
def test_a_robot_that_is_paused_while_it_recovers_is_replayed_too(tmp_path, bundle, last):
    """In the tick in which it is made to wait it is still shown its way out."""
    recovering: list[int] = []

    def command(operator, tick, record):
        if tick == 3:
            operator.driver.set_goal(operator.goal)
        if record.mode is Mode.RECOVERING:
            recovering.append(tick)
        if recovering and tick == recovering[0] + last:
            operator.driver.pause()
        if recovering and tick == recovering[0] + last + 20:
            operator.driver.resume()

    log = served(tmp_path / "paused.mcap", Operator(250, command), pinned_from=0.3, pinned_until=2.6)
    assert len([tick for tick in log.ticks() if tick.recovering and tick.mode is Mode.HOLD]) == 1
    result = Replay(log, bundle).compare()
    assert result.equal and result.compared["sent"] > 50, result.difference


def test_a_recording_from_before_recovering_was_told_says_so_by_its_mode():
    for mode in (Mode.RECOVERING, Mode.RUNNING):
        decoder = messages.TickDecoder()
        for topic, data in messages.TickEncoder().encode(TickRecord(0, 0.0, 0.0, mode, SensorFrame(0.0))):
            values = json.loads(data)
            if topic == "/tick":
                assert values.pop("recovering") is False
            read = decoder.add(messages.decode(topic, json.dumps(values).encode()))
        assert read.recovering == (mode is Mode.RECOVERING)


def test_questions_of_the_same_stamp_are_kept_once():
    asked, free = _Asked(), empty_map((1.0, 1.0))
    for k in range(3 * ASKED):
        asked.stamp = 0.02 * (k % 300 // 2)
        asked.plan(PlanQuery(np.full((1, 2), k), np.zeros((1, 2)), [free], [VisitMap(free)], np.zeros((1, 10, 2))))
    assert asked.queries[asked.stamp].position[0, 0] == 3 * ASKED - 1
    assert len(asked.queries) == 150


@pytest.mark.parametrize(
    ("value", "change"),
    [
        ("sent", lambda r: replace(r, sent=np.nextafter(r.sent, 9.0)) if r.sent is not None else r),
        ("proposed", lambda r: replace(r, proposed=-r.proposed) if r.proposed is not None else r),
        ("observation", lambda r: replace(r, observation=r.observation * np.float32(1.01))
         if r.observation is not None else r),
        ("plan", lambda r: replace(r, plan=r.plan + 1e-15) if r.plan is not None else r),
    ],
)  # fmt: skip
def test_the_first_tick_that_differs_is_named_to_the_last_bit(tmp_path, bundle, value, change):
    """What is decided in tick 30 is changed in the recording by as little as can be."""
    log = recorded(
        tmp_path / "run.mcap",
        {"seed": 1, "max_steps": 60},
        change=lambda record: change(record) if record.index == 30 else record,
    )
    difference = Replay(log, bundle).compare().difference
    assert (difference.run, difference.tick, difference.value) == (0, 30, value)
    assert f"run 0, tick 30 (0.600 s): {value} is" in str(difference)


def test_a_changed_sensor_value_shows_in_the_estimate(tmp_path, bundle):
    def change(record):
        if record.index != 20:
            return record
        frame: SensorFrame = record.frame
        return replace(record, frame=replace(frame, gyro=frame.gyro + 1e-12))

    log = recorded(tmp_path / "run.mcap", {"seed": 1, "max_steps": 40}, change=change)
    difference = Replay(log, bundle).compare().difference
    assert (difference.tick, difference.value) == (20, "estimate")


def test_other_policies_are_found_out_at_their_first_other_action(tmp_path, bundle):
    onnx = pytest.importorskip("onnx", reason="needs the extra hiernav[train]")
    log = recorded(tmp_path / "run.mcap", {"seed": 1, "max_steps": 20})
    model = onnx.load_from_string(bundle.skill)
    weight = max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))
    changed = onnx.numpy_helper.to_array(weight) * np.float32(1.001)
    weight.CopyFrom(onnx.numpy_helper.from_array(changed, weight.name))
    skill = model.SerializeToString()
    golden = dict(bundle.golden) | {"action": OnnxSkill(skill)(bundle.golden["observation"])}
    manifest = msgspec.structs.replace(bundle.manifest, files={**bundle.manifest.files, "skill.onnx": "0" * 64})
    replay = Replay(log, Bundle(manifest, bundle.planner, skill, golden))
    difference = replay.compare().difference
    assert not replay.same_policies
    first = next(tick.index for tick in log.ticks() if tick.proposed is not None)
    assert (difference.tick, difference.value) == (first, "proposed")


def test_a_recording_that_does_not_say_what_was_run_is_refused(tmp_path, bundle):
    recorder = Recorder(tmp_path / "silent.mcap")
    recorder.close()
    with pytest.raises(LogError, match="what it says of its run"):
        Replay(RunLog(recorder.path), bundle)


def test_a_recording_of_another_robot_is_refused(tmp_path, bundle):
    recorder = Recorder(tmp_path / "car.mcap", {**about().metadata(), "robot": "car"})
    recorder.close()
    with pytest.raises(LogError, match="a drive of 'car', and a bundle for 'point'"):
        Replay(RunLog(recorder.path), bundle)


def test_the_command_says_equal_different_or_refused(tmp_path, capsys):
    run = {"seed": 1, "max_steps": 8}
    good = recorded(tmp_path / "good.mcap", run)
    assert cli.main(["replay", str(good.path)]) == 0
    assert "ticks equal bit for bit" in capsys.readouterr().out
    assert cli.main(["replay", str(good.path), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["equal"] is True
    wrong = recorded(
        tmp_path / "wrong.mcap", run, change=lambda r: replace(r, sent=r.sent + 0.5) if r.index == 8 else r
    )
    assert cli.main(["replay", str(wrong.path)]) == 1
    assert "after 8 equal ticks: run 0, tick 8" in capsys.readouterr().out
    (tmp_path / "cut.mcap").write_bytes(good.path.read_bytes()[:100])
    assert cli.main(["replay", str(tmp_path / "cut.mcap")]) == 2
    assert "not a recording" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(20))
def test_the_lidar_is_dimmed_where_it_was(seed: int) -> None:
    """A robot that stands, is shown ways out, moves on them or does not, and comes clear of the place at any time."""
    rng, free = np.random.default_rng(seed), empty_map((20.0, 20.0))
    recovery, replayed = Recovery(1, 0.1), _Recorded(1, 0.1)
    plan, terms = 0.1 * np.ones((1, 10, 2)) * np.arange(1, 11)[:, None], {"lidar": np.full((1, 10), 0.5)}
    pose, speed, dimmed = np.zeros((1, 3)), 0.0, 0
    for _ in range(600):
        if rng.random() < 0.08:
            speed = rng.choice([0.0, 0.0, 0.05, 0.2])
        pose[0, :2] = np.clip(pose[0, :2] + speed * rng.choice([-1.0, 1.0], p=[0.3, 0.7], size=2), -9.0, 9.0)
        followed = recovery(pose, plan + pose[:, None, :2], [free])
        replayed.plan = followed[0] if recovery.active[0] else None
        assert (replayed(pose, plan + pose[:, None, :2], [free]) == followed).all()
        assert (recovery.dim(terms)["lidar"] == replayed.dim(terms)["lidar"]).all()
        dimmed += int((recovery.dim(terms)["lidar"] < 0.5).any())
    assert 0 < dimmed < 600


def test_what_is_no_number_is_alike_whatever_its_bits_and_zeros_are_not():
    nan, zero = np.array([1.0, float("nan")], np.float32), np.array([0.0, 2.0])
    assert _same(np.array([1.0, float("nan")]), nan) and _same(np.array([1.0, -float("nan")]), nan)
    assert not _same(np.array([float("nan"), 1.0]), nan)
    assert not _same(np.array([-0.0, 2.0]), zero) and _texts(np.array([-0.0, 2.0]), zero) == ("-0.0 (element 0)", "0.0")
