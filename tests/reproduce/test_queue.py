"""Claims about the queue: nothing is run twice, nothing is lost, and a failure is seen."""

from __future__ import annotations

import errno
import fcntl
import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from hiernav.config import NEUTRAL, TrainConfig, deciding_settings
from hiernav.finetune import DEFAULTS
from hiernav.git import git_state
from hiernav.planner import passes
from hiernav.reproduce.cells import Cell, Places, cell_key, training_hash
from hiernav.reproduce.child import CellFailed
from hiernav.reproduce.experiments import EXPERIMENTS, FULL, ROBOTS, SMOKE, catalogue
from hiernav.reproduce.queue import Queue, duration, look_up, select
from hiernav.reproduce.results import ResultError, read_result, read_results, result_path, write_result
from hiernav.reproduce.work import Outcome

ROOT = Path(__file__).parents[2]
CELLS = catalogue(ROOT)


@pytest.fixture
def places(tmp_path: Path) -> Places:
    return Places(tmp_path, tmp_path / "results", tmp_path / "runs")


def cell(name: str, seconds: float = 10.0, **changes) -> Cell:
    given = {"experiment": "astar", "kind": "evaluate", "robot": "point", "variant": "astar", "world": "gremlin"}
    return Cell(name=name, seconds=seconds, **{**given, "settings": {"episodes": 5}, **changes})


DRIVE = {
    "episodes": 8, "reach_rate": 0.75, "reach_ci95": [0.41, 0.93], "steps_mean": 50.0, "steps_half95": 4.0,
    "collisions_mean": 0.5, "collisions_half95": 0.1, "collision_free_rate": 0.5, "spl_mean": 0.9, "spl_half95": 0.02,
    "return_mean": 1.0, "steps_between_plans": 8.0, "endings": {"goal": 6, "timeout": 2},
}  # fmt: skip


class Work:
    """In the place of the work of cells: notes what it is asked for, and does what it is told to."""

    def __init__(self, **errors: BaseException) -> None:
        self.errors, self.calls = errors, []

    def __call__(self, cell, places, report, code):
        self.calls.append(cell.name)
        report(0.5, "half of it")
        if cell.name in self.errors:
            raise self.errors[cell.name]
        return Outcome({"strict": DRIVE}, {"bundle": "b"}, cell.settings)


def test_what_was_run_is_not_run_again(places):
    work = Work()
    cells = [cell("a"), cell("b")]
    assert Queue(cells, places, work).run().done == ["astar/a", "astar/b"]
    assert Queue(cells, places, work).run().done == []
    assert work.calls == ["a", "b"]
    result = read_result(places.results, "astar/a")
    assert result.metrics == {"strict": DRIVE} and result.state == "done"
    assert result.command == "python tools/reproduce.py --only astar/a"
    assert result.machine.cores >= 1 and result.machine.cpu and "mujoco" in result.machine.versions


def test_a_queue_that_is_stopped_goes_on_where_it_was(places):
    cells = [cell("a"), cell("b"), cell("c")]
    tally = Queue(cells, places, Work(b=KeyboardInterrupt())).run()
    assert tally.stopped and tally.done == ["astar/a"] and not tally.failed
    work = Work()
    assert not Queue(cells, places, work).run().stopped
    assert work.calls == ["b", "c"]


def test_a_failure_is_recorded_and_the_rest_goes_on(places):
    cells = [cell("a"), cell("b", needs=("astar/a",)), cell("c")]
    tally = Queue(cells, places, Work(a=CellFailed("ValueError: no such world"))).run()
    assert tally.done == ["astar/c"] and tally.failed == {"astar/a": "ValueError: no such world"}
    assert tally.skipped == {"astar/b": "needs astar/a, which is failed"}
    assert read_result(places.results, "astar/a").error == "ValueError: no such world"
    work = Work()
    queue = Queue(cells, places, work)
    assert [entry.state for entry in queue.entries()] == ["failed", "open", "done"]
    assert queue.run().failed == {"astar/a": "ValueError: no such world (before; --retry-failed runs it again)"}
    assert work.calls == [], "a failed cell was run again unasked"
    queue.run(retry=True)
    assert work.calls == ["a", "b"]
    assert {entry.state for entry in queue.entries()} == {"done"}


def test_what_drives_a_training_that_was_made_elsewhere_waits_for_its_run_folder(places):
    training = cell("t", kind="train", run="t-0", settings={"stage": "skill"})
    drive = cell("d", run="t-0", needs=(training.id,))
    compared = cell("c", kind="train", run="c-0", settings={"stage": "skill"}, needs=(training.id,))
    Queue([training], places, Work()).run()
    queue = Queue([training, drive, compared], places, work := Work())
    tally = queue.run()
    assert work.calls == ["c"], "a training that is only compared with another needs no more than its result"
    assert "needs astar/t, which was trained elsewhere" in tally.skipped[drive.id]
    assert str(places.runs / "t-0") in tally.skipped[drive.id] and read_result(places.results, drive.id) is None
    (places.runs / "t-0" / "skill").mkdir(parents=True)
    (places.runs / "t-0" / "skill" / "checkpoint.pt").touch()
    assert queue.run().skipped.keys() == {drive.id}, "a training that is half way here was driven"
    (places.runs / "t-0" / "summary.json").write_text('{"skill": {}}')
    assert queue.run().done == [drive.id]


def test_what_drove_a_training_drives_again_once_it_was_trained_anew(places):
    drive, folder = cell("d", run="t-0"), places.runs / "t-0"
    (folder / "skill").mkdir(parents=True)
    (folder / "summary.json").write_text('{"skill": {"seconds": 1.0}}')

    def execute(each, where, report, code):
        return Outcome({"strict": DRIVE}, {"run": each.run, "trained": training_hash(each, where)}, each.settings)

    assert Queue([drive], places, execute).run().done == [drive.id]
    assert look_up(drive, places).state == "done"
    (folder / "summary.json").write_text('{"skill": {"seconds": 2.0}}')
    assert look_up(drive, places).state == "changed"
    assert Queue([drive], places, execute).run().done == [drive.id]
    shutil.rmtree(folder)
    assert look_up(drive, places).state == "done", "where it was trained elsewhere its result is all there is"


def test_no_cell_is_started_that_does_not_fit_into_the_budget(places):
    work = Work()
    tally = Queue([cell("long", 1e6), cell("short", 50.0)], places, work).run(budget=100.0)
    assert work.calls == ["short"]
    assert list(tally.skipped) == ["astar/long"]
    assert tally.skipped["astar/long"].startswith(f"takes about {duration(1e6)}")
    assert read_result(places.results, "astar/long") is None


def test_a_result_knows_its_commit_and_whether_code_was_changed(places):
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(places.root), "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    assert git_state(places.root) == (None, None)
    (places.root / "results").mkdir()
    for name in ("code.py", "results/a.json"):
        (places.root / name).write_text("1")
    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "x")
    (places.root / "results/a.json").write_text("2")
    (places.root / "new.py").write_text("2")
    apart = [places.root / "results", places.root.parent / "elsewhere"]
    assert git_state(places.root, apart) == (git("rev-parse", "HEAD"), False)
    (places.root / "code.py").write_text("2")
    assert git_state(places.root, apart) == (git("rev-parse", "HEAD"), True)


def test_a_result_has_the_commit_at_which_its_cell_started(places):
    def git(*arguments: str) -> str:
        command = ["git", "-C", str(places.root), "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    def commit(name: str) -> str:
        path = places.root / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(f"{path.read_text() if path.exists() else ''}1")
        git("add", name)
        git("commit", "-q", "-m", "x")
        return git("rev-parse", "HEAD")

    git("init", "-q")
    commits = [commit("hiernav/code.py")]
    following = {"a": "docs/text.md", "b": "hiernav/code.py"}

    def work(cell, places, report, code):
        if cell.name in following:
            commits.append(commit(following[cell.name]))
        return Outcome({"strict": DRIVE}, {})

    Queue([cell("a"), cell("b"), cell("c")], places, work).run()
    found = [read_result(places.results, f"astar/{name}") for name in "abc"]
    assert [(each.commit, each.dirty) for each in found] == [
        (commits[0], False),
        (commits[1], False),
        (commits[2], True),  # some of it was loaded before
    ]


def test_a_training_is_told_the_code_that_its_result_names(places, monkeypatch):
    told = []

    def work(cell, places, report, code):
        told.append(code)
        return Outcome({"strict": DRIVE}, {})

    queue = Queue([cell("a")], places, work)
    monkeypatch.setattr(Queue, "_code", lambda _: ("abc", True))
    queue.run()
    result = read_result(places.results, "astar/a")
    assert told == [("abc", True)] == [(result.commit, result.dirty)]


def test_a_training_that_went_on_took_what_all_its_processes_took(places):
    training = cell("t", 2400.0, kind="train", run="t-0", settings={"stage": "skill"}, experiment="planners")
    (places.runs / "t-0").mkdir(parents=True)
    line = {"stage": "skill", "step": 520_000, "steps_per_second": 300.0, "seconds": 1700.0}
    (places.runs / "t-0" / "rates.jsonl").write_text(json.dumps(line) + "\n")
    other = cell("u", 600.0, kind="train", run="u-0", settings={"stage": "skill"})
    queue = Queue([training, other], places, Work())
    queue.run()
    result = read_result(places.results, "planners/t")
    assert 1700.0 <= result.seconds < 1760.0
    assert result_path(places.results, "astar/u").exists()

    def left_after(seconds: float) -> float:
        write_result(places.results, msgspec.structs.replace(result, seconds=seconds))
        return Queue([training], places, Work()).estimate(other)

    assert left_after(1800.0) == pytest.approx(600.0 * 1800 / 2400)
    assert left_after(34.0) == 600.0, "the seconds of its last process say nothing about a training"


def started(places: Places, seconds: float) -> Cell:
    """A training that has taken some seconds."""
    training = cell("t", 2400.0, kind="train", run="t-0", settings={"stage": "skill"})
    (places.runs / "t-0").mkdir(parents=True)
    line = {"stage": "skill", "step": 500_000, "steps_per_second": 210.0, "seconds": seconds}
    (places.runs / "t-0" / "rates.jsonl").write_text(json.dumps(line) + "\n")
    return training


@pytest.mark.parametrize(("spent", "starts"), [(2350.0, True), (1000.0, False), (9000.0, True)])
def test_a_budget_counts_what_is_left_of_a_training(places, spent, starts):
    tally = Queue([started(places, spent)], places, Work()).run(budget=1200.0)
    assert bool(tally.done) is starts
    if not starts:
        assert tally.skipped["astar/t"].startswith(f"takes about {duration(1400.0)}")


def test_a_damaged_run_folder_ends_no_queue(places):
    training = started(places, 100.0)
    Queue([training], places, Work()).run()
    (places.runs / "t-0" / "rates.jsonl").write_text("\0\0\n")
    queue = Queue([training, cell("u", kind="train", run="t-0", settings={"stage": "skill"})], places, Work())
    assert [entry.state for entry in queue.entries()] == ["done", "open"]
    assert queue.estimate(training) == 2400.0
    assert queue.run(budget=1e5).done == ["astar/u"]


def test_estimates_follow_what_cells_of_a_kind_took(places):
    queue = Queue([cell("a", 10.0), cell("film", 10.0, kind="film")], places, Work())
    queue.estimate.learn(cell("a", 10.0), 30.0)
    assert queue.estimate(cell("b", 20.0)) == pytest.approx(60.0)
    assert queue.estimate(cell("film", 20.0, kind="film")) == 20.0


def test_other_settings_make_a_cell_open_again(places):
    Queue([cell("a")], places, Work()).run()
    other = cell("a", settings={"episodes": 6})
    assert look_up(other, places).state == "changed"
    work = Work()
    Queue([other], places, work).run()
    assert work.calls == ["a"] and look_up(other, places).state == "done"
    longer = msgspec.structs.replace(other, seconds=99.0)
    assert look_up(longer, places).state == "done", "an estimate is not a setting"


def test_other_passes_or_another_fine_tuning_make_their_cells_open_again(places, monkeypatch):
    def keys():
        return {each.id: cell_key(each, replace(places, root=ROOT)) for each in catalogue(ROOT)}

    before = keys()
    with monkeypatch.context() as patch:
        patch.setattr(passes, "UPDATES", 4_000)
        changed = {name for name, key in keys().items() if key != before[name]}
    assert changed == {name for name in before if name.startswith("table2/")} and len(changed) == 24
    monkeypatch.setitem(DEFAULTS, "planner.epochs", "20")
    changed = {name for name, key in keys().items() if key != before[name]}
    assert changed == {name for name in before if "finetuned" in name} and len(changed) == 36


def test_another_bundle_makes_its_cells_open_again(places):
    shutil.copytree(ROOT / "deploy/bundles/point", places.root / "bundle")
    cells = [cell("a", bundle="bundle"), cell("b")]
    Queue(cells, places, Work()).run()
    with (places.root / "bundle" / "skill.onnx").open("ab") as file:
        file.write(b"!")
    assert [look_up(each, places).state for each in cells] == ["changed", "done"]


def test_a_bundle_that_is_replaced_during_a_cell_leaves_no_result(places):
    shutil.copytree(ROOT / "deploy/bundles/point", places.root / "bundle")

    def work(cell, places, report, code):
        (places.root / "bundle" / "skill.onnx").write_bytes(b"another")
        return Outcome({}, {})

    tally = Queue([cell("a", bundle="bundle")], places, work).run()
    assert not tally.done and "replaced" in tally.skipped["astar/a"]
    assert read_result(places.results, "astar/a") is None


def test_two_queues_do_not_work_on_the_same_cell(places):
    work = Work()
    lock = places.runs / "locks" / "astar-a.lock"
    lock.parent.mkdir(parents=True)
    with lock.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        tally = Queue([cell("a"), cell("b")], places, work).run()
    assert work.calls == ["b"] and "another queue" in tally.skipped["astar/a"]


def test_where_there_are_no_locks_a_queue_runs_all_the_same(places, monkeypatch):
    def unknown(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr(fcntl, "flock", unknown)
    work = Work()
    assert not Queue([cell("a")], places, work).run().skipped and work.calls == ["a"]


@pytest.mark.parametrize("retry", [False, True])
def test_what_another_queue_has_failed_at_meanwhile_is_not_tried_again(places, retry):
    cells = [cell("a"), cell("b"), cell("c")]
    Queue(cells[1:2], places, Work(b=CellFailed("before"))).run()
    calls = []

    def work(cell, places, report, code):
        calls.append(cell.name)
        if cell.name == "a":
            Queue(cells[1:], places, Work(b=CellFailed("again"), c=CellFailed("too"))).run(retry=retry)
        raise CellFailed("too")

    tally = Queue(cells, places, work).run(retry=True)
    assert calls == (["a"] if retry else ["a", "b"]), "b was not retried by the other queue, and is by this one"
    assert tally.skipped["astar/c"] == "another queue has run it: failed"


@pytest.mark.parametrize(
    ("damage", "part"),
    [
        (lambda text: text[: len(text) // 2], "not a result of this version"),
        (lambda text: "", "not a result of this version"),
        (lambda text: text.replace('"metrics"', '"metrix"'), "metrix"),
        (lambda text: text.replace('"seconds": ', '"seconds": "soon", "x": '), "seconds"),
        (lambda text: text.replace('"state": "done"', '"state": "failed"'), "state 'failed' with error None"),
        (lambda text: text.replace('"steps_mean": 50.0', '"steps_mean": "few"'), "metrics.strict"),
        (lambda text: text.replace('"endings"', '"ends"'), "metrics.strict"),
        (lambda text: text.replace('"strict"', '"lax"'), "no metrics.strict"),
        (lambda text: text.replace('"curves": {}', '"curves": {"evaluation": [{"reach_rate": 1.0}]}'), "has no step"),
        (lambda text: text.replace('"cell": "a"', '"cell": "b"'), "holds the result of astar/b"),
    ],
)
def test_a_damaged_result_is_named_and_neither_used_nor_overwritten(places, damage, part):
    queue = Queue([cell("a"), cell("c")], places, Work())
    queue.run()
    path = result_path(places.results, "astar/a")
    text = damage(path.read_text())
    path.write_text(text)
    results, damaged = read_results(places.results)
    assert [result.id for result in results] == ["astar/c"]
    assert len(damaged) == 1 and str(path) in damaged[0] and part in damaged[0]
    with pytest.raises(ResultError, match="a.json"):
        read_result(places.results, "astar/a")
    assert [entry.state for entry in queue.entries()] == ["damaged", "done"]
    queue.run()
    assert path.read_text() == text
    queue.run(retry=True)
    assert queue.entries()[0].state == "done"


def test_numbers_that_are_not_finite_are_written_as_unknown(places):
    nothing = float("nan")
    work = Outcome({"error": nothing}, {}, {}, {"c": [{"step": 1.0, "x": nothing}]})
    Queue([cell("a", experiment="planners")], places, lambda *_: work).run()
    result = read_result(places.results, "planners/a")
    assert result.metrics == {"error": None} and result.curves == {"c": [{"step": 1.0, "x": None}]}
    json.loads(result_path(places.results, "planners/a").read_text(), parse_constant=pytest.fail)


@pytest.mark.parametrize("size", [FULL, SMOKE], ids=["full", "smoke"])
def test_the_catalogue_is_whole_and_in_an_order_that_can_be_run(size):
    cells = catalogue(ROOT, size)
    seen: set[str] = set()
    for each in cells:
        assert each.id not in seen
        assert set(each.needs) <= seen, each.id
        seen.add(each.id)
    assert {each.experiment for each in cells} == set(EXPERIMENTS)
    for robot in ROBOTS:
        seeds = {each.seed for each in cells if each.robot == robot and each.experiment == "sample_efficiency"}
        assert len(seeds) == {"point": 5, "car": 5, "doggo": 3}[robot]
        for variant in ("baseline", "ours", "finetuned"):
            worlds = [c.world for c in cells if (c.experiment, c.robot, c.variant) == ("table3", robot, variant)]
            count = len(seeds) if robot == "doggo" else 0
            assert sorted(worlds) == sorted(size.worlds * count), "the paper's Table III is of the quadruped"
    assert {each.seed for each in catalogue(ROOT, size, seeds=4)} == {None, 0, 1, 2, 3}
    assert {each.robot for each in catalogue(ROOT, size, robots=["car"])} == {"car"}


def test_an_ablation_differs_from_ours_and_its_folder_too():
    cells = catalogue(ROOT, seeds=1)
    for robot in ROBOTS:
        trained = [c for c in cells if c.robot == robot and c.kind == "train" and c.experiment != "planners"]
        assert len({c.config for c in trained}) == len({c.run for c in trained}) == len(trained) >= 2
    assert {c.robot for c in cells if c.experiment == "ablations" and c.kind == "train"} == {"car", "doggo"}


def test_a_setting_that_came_later_makes_no_other_training_of_one_that_has_it_as_it_was():
    configs = {each.variant: each.config for each in catalogue(ROOT, robots=["car"]) if each.kind == "train"}
    assert '"waypoint_frame":"world"' in configs["world-frame"]
    assert not any("waypoint_frame" in config for name, config in configs.items() if name != "world-frame")


@pytest.mark.parametrize("key", ["option.spacing_m", "reward.goal_distance", "planner.mirror", "threads"])
def test_such_a_setting_may_be_of_any_section(monkeypatch, key):
    """Of one that is as it was nothing is told, so that results from before it came stay those of its training."""
    config = TrainConfig()
    before = deciding_settings(config)
    section, _, name = key.rpartition(".")
    values = dict(before[section] if section else before)
    monkeypatch.setitem(NEUTRAL, key, "something else")
    assert deciding_settings(config) == before
    monkeypatch.setitem(NEUTRAL, key, values.pop(name))
    assert deciding_settings(config) == (before | {section: values} if section else values)


def test_what_needs_no_training_can_be_had_alone():
    cells = select(CELLS, training=False)
    assert {each.kind for each in cells} == {"evaluate", "film", "walk"}
    shipped = {"table3", "astar", "walks", "unseen", "replanning", "ablations", "films"}
    assert {each.experiment for each in cells} == shipped
    assert all(each.bundle for each in cells)


def test_a_choice_brings_what_it_needs():
    cells = CELLS
    chosen = select(cells, ["table3/doggo-finetuned-0-gremlin"])
    assert [each.id for each in chosen] == [
        "sample_efficiency/doggo-ours-0", "planners/doggo-0", "table3/doggo-finetuned-0-gremlin"
    ]  # fmt: skip
    assert {each.experiment for each in select(cells, ["table2"])} == {"table2"}
    assert len(select(cells, ["table3/*-shipped-gremlin"])) == 3
    with pytest.raises(ValueError, match="no cell fits 'table4'.*table3"):
        select(cells, ["table4"])
