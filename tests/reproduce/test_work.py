"""Claims about the work of cells, on real policies and tiny trainings, and about the command line."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny_run

from hiernav.evaluate import evaluate, open_policies
from hiernav.reproduce import child, queue, work
from hiernav.reproduce.cells import Cell, Places
from hiernav.reproduce.child import CellFailed, run_in_process
from hiernav.reproduce.experiments import SMOKE, catalogue
from hiernav.reproduce.queue import Queue
from hiernav.reproduce.results import read_result, read_results
from hiernav.reproduce.work import Outcome, driven, run_cell, trained_seconds
from hiernav.run import PhysicsBroke, Run, TrainingDiverged
from hiernav.sim.layout import parse_world
from hiernav.sim.rollout import Episode

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tools" / "reproduce.py"
POINT = ROOT / "deploy" / "bundles" / "point"


def reproduce(*arguments: object, **options) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, **options)


@pytest.fixture
def places(tmp_path: Path) -> Places:
    return Places(ROOT, tmp_path / "results", tmp_path / "runs")


def test_the_papers_protocol_is_the_first_episodes_of_the_strict_one():
    policies = open_policies(POINT)
    world = "gremlin(1.5,1.5,3)"
    together = driven(policies, world, {"episodes": 6, "paper_episodes": 3}, lambda *_: None)
    for protocol, episodes in (("strict", 6), ("paper", 3)):
        alone = evaluate(policies, [parse_world(world)], protocol, episodes=episodes)[world]
        assert alone.items() >= {
            key: value for key, value in together[protocol].items() if key in alone and key not in ("seconds",)
        }.items()  # fmt: skip
    assert together["paper"]["collisions_mean"] == 0.0
    for row in together.values():
        assert (row["planner"], row["repair"], row["recover"], row["period"]) == ("cnn", True, True, None)


def test_returns_of_a_bundle_are_told_by_a_reward_that_is_given_alone():
    policies = open_policies(POINT)
    settings = {"episodes": 2, "paper_episodes": 1}
    for reward in (None, policies.config.reward):
        found = driven(policies, "pillar(1.2,1.2,1)", settings, lambda *_: None, reward)
        assert {row["return_mean"] is None for row in found.values()} == {reward is None}


def test_half_widths_and_steps_between_plans_are_those_of_the_episodes():
    def episode(steps, collisions, driven, replans, recoveries, reached=True):
        reason = "goal" if reached else "timeout"
        return Episode(0, reached, reason, steps, 300, collisions, 0.0, driven, 1.0, replans, 0, recoveries)

    done = [
        episode(40, 0, 2.0, {"start": 1, "half_index": 3, "goal": 1}, 0),
        episode(60, 3, 1.0, {"start": 1, "d_update": 1, "goal": 1}, 2),
        episode(300, 1, 1.0, {"start": 1}, 1, reached=False),
        episode(20, 0, float("nan"), {"start": 1, "goal": 1}, 0),
    ]
    done[3] = replace(done[3], shortest_length=float("nan"))
    more = work._more(done)
    # reaching the goal asks for no plan, coming back from a recovery does
    assert more["steps_between_plans"] == pytest.approx(420 / (4 + 2 + 1 + 1 + 3))

    def half(*values):
        mean = sum(values) / len(values)
        spread = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
        return pytest.approx(1.96 * (spread / len(values)) ** 0.5)

    assert more["steps_half95"] == half(40, 60, 300, 20)
    assert more["collisions_half95"] == half(0, 3, 1, 0)
    assert more["spl_half95"] == half(0.5, 1.0, 0.0), "that of the last one is not known"
    assert work._more(done[:1])["steps_half95"] is None


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({}, {"planner": "cnn", "repair": True, "recover": True, "predict": True, "period": None, "invalid": True}),
        ({"repair": False}, {"repair": False}),
        ({"recover": False}, {"recover": False}),
        ({"predict": False}, {"predict": False}),
        ({"invalid": False}, {"invalid": False}),
        ({"planner": "astar"}, {"planner": "astar", "repair": False}),
    ],
)
def test_a_cell_is_driven_as_its_settings_say(settings, told):
    found = driven(
        open_policies(POINT), "pillar(1.2,1.2,1)", {"episodes": 1, "paper_episodes": 1, **settings}, lambda *_: None
    )
    for row in found.values():
        assert row.items() >= told.items()


def test_walks_are_along_plans_of_the_network_the_same_verified_and_of_the_expert(places, monkeypatch):
    asked = []

    def walked(policies, world, planner, repair, episodes, seed, on_episodes):
        asked.append((str(world), planner, repair, episodes, seed))
        return {"planner": planner, "repair": repair, "seconds": 1.0}

    monkeypatch.setattr(work, "open_policies", lambda _: None)
    monkeypatch.setattr(work, "evaluate_plans", walked)
    cell = next(each for each in catalogue(ROOT) if each.id == "walks/point-two-room")
    outcome = run_cell(cell, places, lambda *_: None, (None, None))
    wanted = {"network": ("cnn", False), "verified": ("cnn", True), "astar": ("astar", False)}
    assert asked == [("two-room", *who, cell.settings["episodes"], work.EVALUATION_SEED) for who in wanted.values()]
    assert outcome.metrics == {name: {"planner": who[0], "repair": who[1]} for name, who in wanted.items()}


def test_a_fixed_period_is_what_lies_between_plans():
    policies = open_policies(POINT)
    settings = {"episodes": 2, "period": 7, "invalid": False}
    strict = driven(policies, "pillar(1.2,1.2,1)", settings, lambda *_: None)["strict"]
    assert 6.0 < strict["steps_between_plans"] <= 7.0
    ruled = driven(policies, "pillar(1.2,1.2,1)", {"episodes": 2}, lambda *_: None)["strict"]
    assert ruled["steps_between_plans"] > 12.0


@pytest.mark.train
def test_a_training_that_was_stopped_goes_on_from_its_checkpoint(places, capsys):
    places = replace(places, runs=places.runs / "#1 [x]: y")  # YAML would read it otherwise
    size = replace(SMOKE, training=(*SMOKE.training, "skill.num_envs=1", "skill.total_steps=640"))
    cell = next(c for c in catalogue(ROOT, size, 1, ["point"]) if c.id == "sample_efficiency/point-ours-0")

    def stop(share: float, what: str) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_cell(cell, places, stop, ("abc", False))
    capsys.readouterr()
    outcome = run_cell(cell, places, lambda *_: None, ("def", True))
    assert "going on after step 256 of 640" in capsys.readouterr().out
    assert [point["step"] for point in outcome.curves["evaluation"]] == [256, 512, 640]
    assert outcome.source["commits"] == ["abc", "def with changes"], "what the queue says that they ran"
    first, *_, last = [json.loads(line)["seconds"] for line in (places.runs / cell.run / "rates.jsonl").open()]
    assert 0.0 < first < last <= trained_seconds(cell, places)
    assert outcome.settings["skill.device"] in ("cpu", "cuda")
    assert outcome.settings["skill.precision"] in ("float32", "bfloat16")
    assert outcome.settings["skill.total_steps"] == 640 and "run_dir" not in outcome.settings
    assert outcome.metrics["strict"]["planner"] == "astar"


@pytest.mark.train
@pytest.mark.parametrize(
    ("breaks", "error", "tries"),
    [(0, PhysicsBroke, 1), (3, PhysicsBroke, 4), (99, PhysicsBroke, work.BREAKS), (99, TrainingDiverged, 1)],
)
def test_a_training_whose_physics_breaks_is_gone_on_with(tmp_path, monkeypatch, breaks, error, tries):
    from hiernav import training

    Run.create(tiny_run.config(tmp_path / "run")).close()
    tried = []

    def train(run: Run, *_: object) -> None:
        tried.append(run.path)
        if len(tried) <= breaks:
            raise error("at step 5")

    monkeypatch.setattr(training, "train", train)
    with pytest.raises(error) if breaks == 99 else nullcontext():
        work._train_run(tmp_path / "run", "skill", lambda *_: None, ("abc", False))
    assert tried == tries * [tmp_path / "run"]


@pytest.mark.parametrize("gpu", ["NVIDIA H100", None])
def test_a_gpu_is_told_by_the_process_that_computes_if_torch_sees_one_there(places, monkeypatch, gpu):
    cuda = SimpleNamespace(is_available=lambda: gpu is not None, get_device_name=lambda: gpu)
    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(cuda=cuda))
    monkeypatch.setattr(work, "_walk", lambda *_: Outcome({}, {}))
    cell = next(each for each in catalogue(ROOT) if each.kind == "walk")
    written = []
    monkeypatch.setattr(queue, "write_result", lambda _, result: written.append(result))
    Queue([cell], places, run_cell).run()
    assert [result.machine.gpu for result in written] == [gpu]


def test_a_run_that_got_its_planner_elsewhere_has_no_curve_of_it(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"stage": "evaluation", "step": 1, "reach_rate": 0.5}\n')
    assert work._curve(tmp_path, "evaluation") == [{"step": 1, "reach_rate": 0.5}]
    with pytest.raises(ValueError, match="no row of 'planner'"):
        work._curve(tmp_path, "planner")


def test_an_error_in_a_cells_process_is_its_failure(places):
    cell = Cell(
        experiment="astar", name="a", kind="evaluate", robot="point", variant="astar", seconds=1.0,
        world="gremlin", bundle="deploy/bundles/nothing", settings={"episodes": 1},
    )  # fmt: skip
    log = places.runs / "logs" / "astar-a.log"
    log.parent.mkdir(parents=True)
    log.write_text("what it printed before\n")
    with pytest.raises(CellFailed, match=r"^\w+: [^\n]*deploy/bundles/nothing[^\n]* \((?!child)\w+\.py:\d+\)$"):
        run_in_process(cell, places, lambda *_: None, (None, None))
    printed = log.read_text()
    assert printed.startswith("what it printed before\n") and "Traceback" in printed


def test_a_process_that_dies_is_a_failure_that_names_the_signal(places):
    cell = next(c for c in catalogue(ROOT, robots=["point"]) if c.id == "table3/point-shipped-gremlin")

    def kill(share: float, what: str) -> None:
        import multiprocessing

        (process,) = multiprocessing.active_children()
        process.kill()

    with pytest.raises(CellFailed, match="SIGKILL, perhaps for want of memory; what it printed is in .*[.]log$"):
        run_in_process(cell, places, kill, (None, None))


def test_a_process_that_exits_by_itself_is_a_failure_that_names_its_code(places):
    log = places.runs / "logs" / "astar-a.log"
    assert child._death(3, log) == f"its process ended with code 3; what it printed is in {log}"
    assert child._death(-signal.SIGSEGV, log).startswith("its process was ended by SIGSEGV; what it printed")


WORK_OF_A_QUEUE = """
import multiprocessing
import threading

from hiernav.orphans import end_with_parent

FOREVER = threading.Event()


def work(told):
    end_with_parent()
    with open(told, "w") as file:
        print("at work", file=file, flush=True)
        FOREVER.wait(20.0)
        print("still at work", file=file)


if __name__ == "__main__":
    multiprocessing.get_context("forkserver").Process(target=work, args=(TOLD,)).start()
    FOREVER.wait()
"""


def test_a_queue_that_is_killed_leaves_no_process_at_work(tmp_path):
    told, script = tmp_path / "told", tmp_path / "script.py"
    os.mkfifo(told)
    script.write_text(f"TOLD = {str(told)!r}\n{WORK_OF_A_QUEUE}")
    pipe = os.open(told, os.O_RDONLY | os.O_NONBLOCK)

    def said() -> bytes:
        assert select.select([pipe], [], [], 120.0)[0], "nothing was said"
        return os.read(pipe, 100)

    with subprocess.Popen([sys.executable, str(script)]) as parent:
        try:
            assert said() == b"at work\n"
        finally:
            parent.kill()
        assert said() == b""  # nobody has the pipe open any more
    os.close(pipe)


def test_a_queue_that_is_asked_to_end_ends_with_its_process_and_without_a_result(tmp_path):
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), "--only", "table3/point-shipped-gremlin", "--results", str(tmp_path / "results"),
         "--runs", str(tmp_path / "runs")],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    log = tmp_path / "runs" / "logs" / "table3-point-shipped-gremlin.log"
    deadline = time.monotonic() + 300.0
    while not log.exists():  # its process is at work
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 130 and "the same command goes on" in out
    assert read_results(tmp_path / "results") == ([], [])


@pytest.mark.train
def test_the_command_trains_drives_and_films_and_does_not_repeat_itself(tmp_path):
    wanted = ("--smoke", "--seeds", "1", "--results", tmp_path / "results", "--runs", tmp_path / "runs",
              "--only", "table3/doggo-ours-*-pillar*", "table3/doggo-shipped-finetuned-pillar*", "films/point-*-2",
              "table2/default-16-0")  # fmt: skip
    listed = json.loads(reproduce(*wanted, "--list", "--json").stdout)
    done = reproduce(*wanted, "--json")
    assert done.returncode == 0, done.stderr
    tally = json.loads(done.stdout)
    assert tally["done"] == [entry["cell"] for entry in listed]
    results, damaged = read_results(tmp_path / "results")
    assert not damaged and {result.id for result in results} == set(tally["done"])
    assert {(r.experiment, r.variant) for r in results} == {
        ("table3", "shipped"), ("table3", "shipped-finetuned"), ("table3", "ours"), ("sample_efficiency", "ours"),
        ("planners", "ours"), ("table2", "default"), ("films", "shipped"),
    }  # fmt: skip
    film = read_result(tmp_path / "results", "films/point-pillar-1.2-1.2-2")
    assert (tmp_path / "results" / "films" / film.metrics["file"]).stat().st_size == film.metrics["bytes"] > 1000
    again = reproduce(*wanted, "--json")
    assert json.loads(again.stdout) == {"done": [], "failed": {}, "skipped": {}, "stopped": False}
    assert {entry["state"] for entry in json.loads(reproduce(*wanted, "--list", "--json").stdout)} == {"done"}


@pytest.mark.slow
@pytest.mark.train
def test_every_cell_can_be_run(tmp_path):
    done = reproduce("--smoke", "--results", tmp_path / "results", "--runs", tmp_path / "runs", "--json")
    assert done.returncode == 0, done.stderr
    tally = json.loads(done.stdout)
    assert not tally["failed"] and not tally["skipped"]
    assert len(tally["done"]) == len(catalogue(ROOT, SMOKE, 1))


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["--budget", "soon"], "write 45m, 3h or 1h30m"),
        (["--seeds", "0"], "must be at least 1"),
        (["--only", "table4", "--list"], "no cell fits 'table4'"),
        (["--robots", "ant"], "invalid choice"),
    ],
)
def test_bad_input_is_one_error_that_says_what_to_do(arguments, part):
    done = reproduce(*arguments)
    assert done.returncode == 2 and part in done.stderr and "Traceback" not in done.stderr


def test_help_lists_every_experiment():
    text = reproduce("--help").stdout
    for word in ("table2", "sample_efficiency", "table3", "replanning", "astar", "ablations", "--budget", "--smoke"):
        assert word in text
