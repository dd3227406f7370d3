"""Claims about run folders: nothing is overwritten, nothing is half written, and what was logged is what is read."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
import tiny_run
from locked import other_process

from hiernav import lock as lock_module
from hiernav import run as run_module
from hiernav.config import ConfigError, load_config
from hiernav.run import Run, RunError, newest_run, spent_seconds


@pytest.fixture
def run(tmp_path: Path) -> Run:
    made = Run.create(tiny_run.config(tmp_path / "run"))
    yield made
    made.close()


def lines(run: Run) -> list[dict]:
    return [json.loads(line) for line in (run.path / "metrics.jsonl").read_text().splitlines()]


def test_a_new_run_holds_every_value_of_its_configuration(run):
    assert load_config(run.path / "config.yaml") == run.config
    assert Run.open(run.path).config == run.config
    text = (run.path / "config.yaml").read_text()
    assert "total_steps: 768" in text and "tau:" in text


def test_a_run_without_a_folder_gets_one_named_after_time_robot_and_seed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = Run.create(load_config(None, ["robot=car", "seed=12"]))
    assert made.path.parent == Path("runs")
    assert made.path.name.endswith("-car-12")
    assert Run.open(made.path).config.seed == 12


def test_an_existing_run_is_refused_and_stays_as_it_is(run):
    before = (run.path / "config.yaml").read_bytes()
    with pytest.raises(RunError, match=r"holds a run already: go on with --resume .*run, or choose another run_dir"):
        Run.create(tiny_run.config(run.path, "seed=77"))
    assert (run.path / "config.yaml").read_bytes() == before


def test_a_folder_that_is_no_run_is_refused_with_a_hint(tmp_path):
    for path in (tmp_path, tmp_path / "absent"):
        with pytest.raises(RunError, match=r"is not a run folder: it has no config\.yaml; `hiernav train` makes one"):
            Run.open(path)
    assert list(tmp_path.iterdir()) == []


def test_a_run_whose_configuration_is_broken_is_named(run):
    (run.path / "config.yaml").write_text("skill: {num_envs: 0}\n")
    with pytest.raises(ConfigError, match=r"run/config\.yaml: skill\.num_envs = 0"):
        Run.open(run.path)


def test_a_run_from_before_a_setting_was_refused_can_still_be_opened(run):
    (run.path / "config.yaml").write_text("planner: {preset: paper, hypotheses: 6}\n")
    assert Run.open(run.path).config.planner.hypotheses == 6


def test_summaries_of_the_stages_are_merged(run):
    run.summarize({"planner": {"error": 0.1}})
    run.summarize({"skill": {"reach_rate": 0.5}})
    run.summarize({"planner": {"error": 0.05}})
    assert json.loads((run.path / "summary.json").read_text()) == {
        "planner": {"error": 0.05},
        "skill": {"reach_rate": 0.5},
    }


@pytest.mark.train
def test_seconds_of_a_stage_are_those_of_all_processes_that_worked_on_it(run, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(run_module.time, "perf_counter", lambda: now[0])
    run.start_clock("skill")
    now[0] += 40.0
    run.log_rates("skill", 200, {"steps_per_second": 10.0})
    now[0] += 3.0  # lost: the process is stopped
    again = Run.open(run.path)
    now[0] += 1000.0
    again.start_clock("skill")
    now[0] += 2.0
    again.log_rates("skill", 220, {"steps_per_second": 10.0})
    assert spent_seconds(run.path, "skill") == 42.0 and spent_seconds(run.path, "planner") == 0.0
    run.summarize({"skill": {"seconds": 50.0}})
    assert spent_seconds(run.path, "skill") == 50.0, "the evaluation at the end is in the summary alone"
    again.close()


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("summary.json", '{"skill": {"seconds": 1.0}}\n{"skill": {}}\n'),
        ("summary.json", "[1]"),
        ("summary.json", '{"skill": [2]}'),
        ("summary.json", '{"skill": {"seconds": "long"}}'),
        ("summary.json", ""),
        ("rates.jsonl", '{"stage": "skill", "step": 1} {"stage": "skill", "step": 2}\n'),
        ("rates.jsonl", '{"stage": "skill", "st\n{"stage": "skill", "step": 2}\n'),
        ("rates.jsonl", '{"step": 2}\n'),
        ("rates.jsonl", '{"stage": "skill"}\n'),
        ("rates.jsonl", '{"stage": "skill", "step": 1, "seconds": "long"}\n'),
        ("rates.jsonl", "3\n"),
        ("rates.jsonl", "[" * 100_000 + "\n"),
    ],
)
def test_a_damaged_log_is_named_and_what_to_do(run, name, text):
    (run.path / name).write_text(text)
    calls = [lambda: run.start_clock("skill")]
    if name == "summary.json" and "skill" not in text:
        calls.append(lambda: run.summarize({"skill": {"seconds": 1.0}}))
    for call in calls:
        with pytest.raises(
            RunError, match=rf"run/{name} is damaged \(.+\): restore it, or remove it and go on"
        ) as error:
            call()
        assert "\n" not in str(error.value)
    assert (run.path / name).read_text() == text


def test_one_process_at_a_time_writes_to_a_run_and_others_read_it(run):
    log = run.path / "metrics.jsonl"
    log.write_text("what the other one wrote\n")
    with other_process(run.path) as got:
        assert got
        for write in (
            lambda: run.load("skill", rewind=True),
            lambda: run.log("skill", 1, {"reach_rate": 0.5}),
            lambda: run.log_rates("skill", 1, {"steps_per_second": 1.0}),
            lambda: run.summarize({"skill": {}}),
            lambda: run.writing().__enter__(),
        ):
            with pytest.raises(RunError, match=r"run is in use: another process trains in it; [^\n]*$"):
                write()
        assert log.read_text() == "what the other one wrote\n"
        assert run.load("skill") is None and spent_seconds(run.path, "skill") == 0.0  # read
    run.summarize({"skill": {"reach_rate": 0.5}})  # whoever was killed holds nothing
    with other_process(run.path) as got:
        assert not got
    again = Run.open(run.path)  # in the same process
    again.summarize({"skill": {}})
    run.close()
    with other_process(run.path) as got:
        assert not got
    again.close()
    with other_process(run.path) as got:
        assert got


def test_a_run_that_is_about_to_be_made_is_not_made_twice(tmp_path):
    with other_process(tmp_path), pytest.raises(RunError, match="in use"):
        Run.create(tiny_run.config(tmp_path))
    made = Run.create(tiny_run.config(tmp_path))
    with other_process(made.path) as got:
        assert got, "whoever made it does not train yet"


def test_where_there_are_no_locks_training_goes_on_without(run, monkeypatch):
    with monkeypatch.context() as patch, other_process(run.path) as got:
        assert got
        patch.setattr(lock_module, "fcntl", None)
        run.summarize({"skill": {}})

    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    with monkeypatch.context() as patch:
        patch.setattr(lock_module.fcntl, "flock", unknown)
        run.summarize({"skill": {}})


def test_seconds_of_a_run_that_tells_only_its_rates_are_those_of_its_steps(run):
    (run.path / "rates.jsonl").write_text(
        '{"stage": "planner", "step": 1, "samples_per_second": 9.0}\n'
        '{"stage": "skill", "step": 200, "steps_per_second": 10.0}\n'
        '{"stage": "skill", "step": 300, "steps_per_second": 20.0}\n'
        '{"stage": "skill", "st'
    )
    assert spent_seconds(run.path, "skill") == 25.0
    run.summarize({"skill": {"seconds": 0.0}})
    assert spent_seconds(run.path, "skill") == 25.0


@pytest.mark.train
def test_metrics_are_one_json_object_a_line_and_curves(run):
    run.log("skill", 100, {"reach_rate": 0.5, "updates": 7})
    run.log("evaluation", 100, {"reach_rate": 0.25})
    assert lines(run) == [
        {"stage": "skill", "step": 100, "reach_rate": 0.5, "updates": 7},
        {"stage": "evaluation", "step": 100, "reach_rate": 0.25},
    ]
    run.close()
    assert [file.name.partition(".tfevents")[0] for file in (run.path / "tensorboard").iterdir()] == ["events.out"]


def curve(run: Run, tag: str) -> list[tuple[int, float]]:
    """Steps and values, as TensorBoard reads them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run.path / "tensorboard"))
    events.Reload()
    return [(event.step, event.value) for event in events.Scalars(tag)]


@pytest.mark.train
@pytest.mark.parametrize("trained_before", [False, True])
def test_a_curve_goes_on_from_the_checkpoint_and_those_of_other_stages_stay(run, trained_before):
    if trained_before:  # a skill that needed no planner
        run.log("skill", 500, {"reach_rate": 0.75})
        run.save("skill", {"steps": 500})
    for step in (1, 2):
        run.log("planner", step, {"loss": 1.0 / step})
        if step == 1:
            run.save("planner", {"epoch": 1})
    run.close()
    again = Run.open(run.path)
    again.load("planner", rewind=True)
    again.log("planner", 2, {"loss": 0.25})
    again.log("planner", 3, {"loss": 0.125})
    again.close()
    if trained_before:
        assert curve(run, "skill/reach_rate") == [(500, 0.75)]
    else:
        assert curve(run, "planner/loss") == [(1, 1.0), (2, 0.25), (3, 0.125)]


@pytest.mark.train
def test_a_checkpoint_is_read_as_it_was_written_and_stages_do_not_mix(run):
    import torch

    assert run.load("skill") is None
    run.save("skill", {"weights": torch.arange(5.0), "steps": 3, "best": None})
    state = Run.open(run.path).load("skill")
    assert torch.equal(state["weights"], torch.arange(5.0))
    assert state["steps"] == 3 and state["best"] is None
    assert run.load("planner") is None
    assert os.listdir(run.path / "skill") == ["checkpoint.pt"]


@pytest.mark.train
def test_going_on_cuts_off_what_was_logged_after_the_checkpoint(run):
    run.log("planner", 1, {"loss": 1.0})
    run.save("planner", {"epoch": 1})
    run.log("planner", 2, {"loss": 0.5})
    assert run.load("planner")["epoch"] == 1 and len(lines(run)) == 2
    run.load("planner", rewind=True)
    assert lines(run) == [{"stage": "planner", "step": 1, "loss": 1.0}]


@pytest.mark.train
def test_going_on_keeps_what_another_stage_has_logged_since(run):
    run.log("planner", 1, {"loss": 1.0})
    run.save("planner", {"epoch": 1})
    run.log("skill", 100, {"reach_rate": 0.1})
    run.save("skill", {"steps": 100})
    run.log("skill", 200, {"reach_rate": 0.2})
    for stage in ("planner", "skill"):  # in the order in which training goes on
        run.load(stage, rewind=True)
    assert [line["step"] for line in lines(run)] == [1, 100]


@pytest.mark.train
def test_going_on_without_a_checkpoint_starts_the_metrics_anew(run):
    run.log("skill", 100, {"reach_rate": 0.1})
    assert run.load("skill", rewind=True) is None
    assert lines(run) == []


@pytest.mark.train
@pytest.mark.parametrize("damage", [b"", b"not a checkpoint", None])
def test_a_damaged_checkpoint_is_named(run, damage):
    run.save("skill", {"steps": 100})
    file = run.path / "skill" / "checkpoint.pt"
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    with pytest.raises(RunError, match=r"skill/checkpoint\.pt cannot be read .*--resume"):
        run.load("skill")


@pytest.mark.train
def test_a_checkpoint_that_would_run_code_is_refused(run):
    import torch

    run.save("skill", {"steps": 100})
    torch.save({"steps": Path("/")}, run.path / "skill" / "checkpoint.pt")  # a pickled class of another library
    with pytest.raises(RunError, match="cannot be read"):
        run.load("skill")


def test_the_newest_run_is_the_one_begun_last(tmp_path: Path) -> None:
    for age, name in enumerate(("b", "a", "c")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").touch()
        os.utime(tmp_path / name / "config.yaml", (100 - age, 100 - age))
    (tmp_path / "no run").mkdir()
    assert newest_run(tmp_path) == tmp_path / "b"


def test_where_there_is_no_run_yet_the_error_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no run folder in .*/: name another one, or make one with `hiernav train`"):
        newest_run(tmp_path)


def test_a_run_notes_each_code_that_trains_in_it_once(run, monkeypatch):
    assert run.codes() == []
    monkeypatch.setattr(run_module, "package_state", lambda: ("abc", True))
    for code in (None, "def", None, "def"):
        run.note_code(code)
    assert Run.open(run.path).codes() == ["abc with changes", "def"]


def test_notes_of_older_runs_are_read_and_what_trained_without_one_is_not_forgotten(run):
    (run.path / "skill").mkdir()
    (run.path / "skill" / "checkpoint.pt").touch()
    run.note_code("def")
    assert run.codes() == ["unknown", "def"]
    (run.path / "commits.txt").write_text("abc\nabc\nno repository\nabc\n")  # a line for each process
    assert run.codes() == ["abc", "no repository"]
