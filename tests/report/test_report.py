"""Claims about the page: its numbers are those of the results, it hides nothing, and it loads nothing."""

from __future__ import annotations

import base64
import html
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import made_up
import msgspec
import numpy as np
import pytest

from hiernav import cli
from hiernav.config import load_config
from hiernav.evaluate import wilson_interval
from hiernav.film.film import film_name
from hiernav.report import figures, paper, tables
from hiernav.report import findings as told
from hiernav.report import page as report_page
from hiernav.report.book import Book, Group, of_seeds
from hiernav.report.page import (
    FILM_LIMIT,
    _ablations,
    _by_robot,
    _command,
    _film,
    _films,
    _gallery,
    _provenance,
    _replanning,
    _strict,
    _targets,
    render,
    write_report,
)
from hiernav.reproduce.cells import Places, cell_key
from hiernav.reproduce.experiments import ROBOTS, TABLE3_ROBOT, UNSEEN, WORLDS
from hiernav.reproduce.results import read_result, result_path, write_result
from hiernav.sim.layout import parse_world
from hiernav.sim.reward import TERMS
from hiernav.sim.robots import get_robot

FAILED = "sample_efficiency/doggo-ours-1"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of every cell, one of which failed."""
    folder = tmp_path_factory.mktemp("results") / "results"

    def change(cell):
        if cell.id == FAILED:
            return made_up.result_of(
                cell, state="failed", error="TrainingDiverged: weights <nan>", metrics={}, curves={}
            )
        return made_up.result_of(cell)

    made_up.write_all(folder, change)
    return folder


@pytest.fixture(scope="module")
def book(results: Path) -> Book:
    return Book.open(results)


@pytest.fixture(scope="module")
def page(book: Book) -> str:
    return render(book)


def text_of(page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", page))


def rows(table: str) -> dict[str, list[str]]:
    """First cell of each row -> texts of the others."""
    found = {}
    for row in re.findall(r"<tr>(.*?)</tr>", table, re.DOTALL)[1:]:
        first, *others = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, re.DOTALL)
        found[text_of(first).strip()] = [" ".join(text_of(other).split()) for other in others]
    return found


@pytest.mark.parametrize("robot", ROBOTS)
def test_numbers_of_the_page_are_those_of_the_results(results, book, robot):
    shown = rows(tables.table3(book, robot, "reach_rate"))
    steps = rows(tables.table3(book, robot, "steps_mean"))
    column = 1 if robot == "doggo" else 0  # of the shipped bundle; the trained seeds' is the next one
    for world in WORLDS:
        slug = film_name(parse_world(world))
        shipped = read_result(results, f"table3/{robot}-shipped-{slug}").metrics["paper"]
        low, high = shipped["reach_ci95"]
        assert shown[world][column] == f"{shipped['reach_rate']:.3f} {low:.3f} – {high:.3f}"
        assert steps[world][column].startswith(f"{shipped['steps_mean']:.1f} ")
        if robot != TABLE3_ROBOT:
            assert shown[world][1] == "not run yet"
            continue
        seeds = range(3)
        values = [read_result(results, f"table3/{robot}-ours-{s}-{slug}").metrics["paper"]["reach_rate"] for s in seeds]
        trained = shown[world][column + 1]
        assert trained.startswith(f"{sum(values) / len(values):.3f} ") and trained.endswith(f"{len(values)} seeds")


def test_walks_are_read_and_shown_for_every_world(results, book, page):
    assert book.damaged == []
    for cell in (cell for cell in made_up.CELLS.values() if cell.kind == "walk"):
        found = read_result(results, cell.id).metrics
        assert f"{100.0 * found['verified']['repairs'] / found['verified']['proposals']:.1f} %" in page
        assert f"<td>{found['network']['collisions_mean']:.3f}</td>" in page


def test_walks_that_failed_or_verified_nothing_have_their_row():
    nothing, failed = (made_up.CELLS[f"walks/point-{world}"] for world in ("gremlin", "two-room"))
    metrics = made_up.result_of(nothing).metrics
    metrics["verified"] = {name: metrics["verified"][name] for name in ("collisions_mean", "reach_rate")}
    shown = rows(
        tables.walks(
            book_of(made_up.result_of(nothing, metrics=metrics), made_up.result_of(failed, **FAILURE)), "point"
        )
    )
    assert shown["gremlin"][-1] == "–" and shown["two-room"][0] == "failed"


def test_what_was_not_run_is_counted_by_its_name():
    planned = [f"sample_efficiency/point-ours-{seed}" for seed in range(5)]
    first = trained("point", "ours", 0)
    beyond = [msgspec.structs.replace(first, cell=f"point-ours-{seed}", seed=seed) for seed in range(5, 15)]
    table = rows(_provenance(book_of(first, *beyond, planned=planned)))
    assert table["sample_efficiency"][:3] == ["11", "0", "4"]


@pytest.mark.parametrize("name", ["reach_rate", "collision_free_rate"])
def test_seeds_that_agree_leave_a_rate_an_interval(name):
    def group(*rates):
        drives = [made_up.drive(np.random.default_rng(0), 1000) | {name: rate} for rate in rates]
        return Group(tuple(trained("point", "ours", seed, metrics={"strict": d}) for seed, d in enumerate(drives)))

    agreeing = group(1.0, 1.0, 1.0).estimate(name)
    assert (agreeing.low, agreeing.high) == wilson_interval(3000, 3000) and agreeing.count == 3
    apart = group(0.2, 0.9, 0.4).estimate(name)
    assert (apart.low, apart.high) == (of_seeds([0.2, 0.9, 0.4], 0.0, 1.0).low, 1.0)


def test_the_papers_numbers_are_there_and_belong_where_they_stand(book, page):
    reach, steps = (rows(tables.table3(book, "doggo", name)) for name in ("reach_rate", "steps_mean"))
    assert [reach["gremlin"][k] for k in (6, 0, 3)] == ["0.67", "0.99", "1.00"]
    assert [steps["pillar(4,4,40)"][k] for k in (6, 0, 3)] == ["273.7", "76.9", "94.1"]
    assert reach["pillar(2,2,10)"][0] == "–"
    for samples, collisions in paper.TABLE2.items():
        assert rows(tables.table2(book))[f"{samples:,}"][1] == f"{collisions:.2f}"
    everything = text_of(page)
    for row in paper.TABLE3.values():
        for rate, count in row:
            assert f"{rate:.2f}" in everything and f"{count:.1f}" in everything


def test_table_2_tells_the_updates_that_each_size_gets(book):
    shown = rows(tables.table2(book))
    assert {samples: row[0] for samples, row in shown.items()} == {
        "1,000": "1,024", "10,000": "1,040", "50,000": "1,176", "100,000": "2,346"
    }  # fmt: skip


def test_an_interval_over_seeds_is_students():
    estimate = of_seeds([1.0, 2.0, 3.0])
    assert (estimate.low, estimate.high) == pytest.approx(
        (2.0 - 4.302653 / math.sqrt(3), 2.0 + 4.302653 / math.sqrt(3))
    )
    assert of_seeds([0.9, 1.0], 0.0, 1.0).high == 1.0
    assert of_seeds([]) is None


def test_results_with_and_without_a_return_are_read(tmp_path):
    result = made_up.result_of(made_up.CELLS["table3/car-shipped-gremlin"])
    for value in (None, -3.0):
        strict = result.metrics["strict"] | {"return_mean": value}
        write_result(tmp_path, msgspec.structs.replace(result, metrics={"strict": strict}))
        book = Book.open(tmp_path)
        assert book.damaged == []
        found = book.group("table3", "shipped", "car", "gremlin").estimate("return_mean")
        assert (found and found.mean) == value


@pytest.mark.parametrize(("returns", "met"), [((2.0, 1.0), True), ((1.0, 2.0), False), ((None, 1.0), False)])
def test_of_equal_reach_rates_known_returns_decide(returns, met):
    results = []
    for variant, value in zip(("ours", "baseline"), returns, strict=True):
        result = made_up.result_of(made_up.CELLS[f"sample_efficiency/point-{variant}-0"])
        strict = result.metrics["strict"] | {"reach_rate": 0.9, "return_mean": value}
        results.append(msgspec.structs.replace(result, metrics={"strict": strict}))
    assert told._above_baseline(Book(Path(), results, []), "point").met is met


def test_beside_the_baseline_the_page_says_that_it_is_never_helped_out(page):
    for section in ("table3", "efficiency"):
        text = page.partition(f'<section id="{section}">')[2].partition("</section>")[0]
        told = " ".join(text_of(text).split())
        assert "this helps only a skill that follows waypoints, so the baseline never gets it." in told


def test_an_interval_over_episodes_is_cut_to_what_is_possible(tmp_path):
    result = made_up.result_of(made_up.CELLS["table3/car-shipped-gremlin"])
    few = {
        "collisions_mean": 8.39,
        "collisions_half95": 10.2,
        "spl_mean": 0.99,
        "spl_half95": 0.02,
        "return_mean": -3.0,
    }
    write_result(
        tmp_path / "results", msgspec.structs.replace(result, metrics={"strict": result.metrics["strict"] | few})
    )
    group = Book.open(tmp_path / "results").group("table3", "shipped", "car", "gremlin")
    collisions, spl = group.estimate("collisions_mean"), group.estimate("spl_mean")
    assert (collisions.low, collisions.high) == (0.0, pytest.approx(18.59))
    assert (spl.low, spl.high) == (pytest.approx(0.97), 1.0)
    assert tables.cell(group, "collisions_mean").count("-") == 0


def test_a_collision_is_defined_by_the_period_of_each_robot(page):
    told = " ".join(text_of(page).split())
    rates = {robot: round(1.0 / get_robot(robot).control_period) for robot in ROBOTS}
    assert (
        f"A collision of a robot is a control step in which it touches an obstacle; there are {rates['point']} of them "
        f"in a second of the point, {rates['car']} of the car and {rates['doggo']} of the doggo."
    ) in told


def test_a_failed_seed_is_shown_as_failed_and_its_error_is_text(page):
    assert "Failed: doggo ours, seed 1." in page
    assert f"{FAILED}: TrainingDiverged: weights &lt;nan&gt;" in page
    book_row = next(row for row in re.findall(r"<tr>.*?</tr>", page, re.DOTALL) if "doggo<br><small>ours" in row)
    assert "1 failed" in book_row


def test_what_was_not_run_is_said_to_be_so(tmp_path):
    (tmp_path / "results").mkdir()
    page = render(Book.open(tmp_path / "results"))
    assert page.count("not run yet") > 50 and "0.000" not in page
    assert "<svg" not in page
    for finding in told.findings(Book.open(tmp_path / "results")):
        assert finding.met is None


def test_the_page_loads_nothing(page):
    assert not re.findall(r"<(?:script|link|iframe|object|embed)\b", page)
    for loaded in re.findall(r"""(?:src|href|xlink:href|srcset|poster|data)\s*=\s*["']([^"']*)""", page):
        assert loaded.startswith(("#", "data:")), loaded
    for loaded in re.findall(r"url\(([^)]*)\)", page):
        assert loaded.startswith("#"), loaded
    assert "@import" not in page
    assert '<meta name="viewport" content="width=device-width' in page and "prefers-color-scheme:dark" in page


def test_references_inside_figures_are_to_what_is_there_once(page):
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:xlink:href="#|href="#|url\(#)([^")]+)', page)) <= set(ids)


def test_the_page_names_the_gpu_of_a_machine():
    with_one, without = (trained("point", "ours", seed) for seed in (0, 1))
    with_one = msgspec.structs.replace(with_one, machine=msgspec.structs.replace(with_one.machine, gpu="NVIDIA H100"))
    told = text_of(_provenance(book_of(with_one, without)))
    assert "Machines: abacus, 2 cores, Linux x86_64; abacus, 2 cores, NVIDIA H100, Linux x86_64." in told


def test_every_figure_and_table_has_its_command(page):
    for experiment in ("table3", "table3 astar", "table2", "sample_efficiency", "replanning", "ablations", "films"):
        assert f"<code>python tools/reproduce.py --only {experiment}</code>" in page


def test_a_curve_has_a_line_for_every_seed(book):
    from hiernav.report.figures import BASELINE, OURS, training

    figure = training(book, "doggo", "reach_rate", "reach rate")
    for color, seeds in ((OURS, 2), (BASELINE, 3)):
        assert len(re.findall(rf"stroke: {color}; stroke-opacity: 0.35", figure)) == seeds
    assert "ours (2 seeds)" in figure and ">reach rate<" in figure


def test_a_mean_of_equal_values_is_that_value():
    """A target is met by a mean that equals it, and the mean of three times 0.99 must not fall short by a rounding."""
    assert of_seeds([0.99, 0.99, 0.99]).mean == 0.99


def test_a_mean_curve_is_of_the_same_steps_and_of_the_same_settings():
    from matplotlib.figure import Figure

    from hiernav.report.figures import _draw_training

    def of(seed, every, rates):
        points = [{"step": every * (k + 1.0), "reach_rate": rate} for k, rate in enumerate(rates)]
        return trained("point", "ours", seed, curves={"evaluation": points})

    results = [of(0, 10_000, [0.0, 0.2, 0.4, 0.6]), of(1, 20_000, [0.4, 0.8]), of(2, 10_000, [1.0, 1.0, 1.0])]
    book = Book(Path(), results, [], changed={results[2].id: "older settings"})
    axes = Figure().add_subplot()
    _draw_training(axes, book, "point", "reach_rate", "reach rate")
    (mean,) = (line for line in axes.lines if line.get_linewidth() > 2)
    assert mean.get_label() == "ours (2 seeds)"
    assert mean.get_xdata() == pytest.approx([20, 30, 40]) and mean.get_ydata() == pytest.approx([0.3, 0.5, 0.7])
    assert sum(line.get_alpha() == 0.35 for line in axes.lines) == 3


def test_the_curves_are_drawn_as_a_picture_too(results, tmp_path, capsys):
    out = tmp_path / "curves.png"
    arguments = ["report", "--results", str(results), "--out", str(tmp_path / "page.html"), "--curves", str(out)]
    assert cli.main(arguments) == 0
    assert f"wrote {out}" in capsys.readouterr().out
    picture = cv2.imread(str(out))
    ours = np.abs(picture.astype(int) - (0xC4, 0x82, 0x3B)).max(axis=-1) < 12
    panels = np.array_split(ours, 3, axis=1)
    assert all(panel.sum() > 100 for panel in panels)


def test_small_films_are_in_the_page_and_large_ones_are_links(results, tmp_path):
    folder = tmp_path / "results"
    cells = [cell for cell in made_up.CELLS.values() if cell.kind == "film"][:2]
    for cell, size in zip(cells, (100, FILM_LIMIT + 1), strict=True):
        write_result(folder, made_up.result_of(cell))
        (folder / "films" / f"{cell.name}.gif").write_bytes(b"G" * size)
    page = render(Book.open(folder), tmp_path)
    assert 'src="data:image/gif;base64,R0dH' in page
    assert f'href="results/films/{cells[1].name}.gif"' in page


def test_a_film_is_stood_for_by_its_end_until_it_is_played():
    films = sorted((made_up.ROOT / "results" / "films").glob("*.mp4"))
    shown = _film(films[0], made_up.ROOT)
    poster = base64.b64decode(re.search(r'poster="data:image/jpeg;base64,([^"]+)"', shown)[1])
    picture = cv2.imdecode(np.frombuffer(poster, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 200 and picture.std() > 10.0


def test_a_damaged_result_is_named_on_the_page_and_by_the_command(results, tmp_path, capsys):
    folder = tmp_path / "results"
    cell = made_up.CELLS["table3/point-shipped-gremlin"]
    write_result(folder, made_up.result_of(cell))
    path = result_path(folder, cell.id)
    path.write_text(path.read_text()[:-20])
    out = tmp_path / "page" / "report.html"
    assert cli.main(["report", "--results", str(folder), "--out", str(out)]) == 1
    assert str(path) in capsys.readouterr().err
    assert str(path) in html.unescape(out.read_text())
    path.unlink()
    assert cli.main(["report", "--results", str(folder), "--out", str(out)]) == 0
    assert cli.main(["report", "--results", str(tmp_path / "nothing"), "--out", str(out)]) == 2


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """As much of the repository as the page asks for, without results."""
    for name in ("configs", "deploy/bundles/point"):
        (tmp_path / name).mkdir(parents=True)
        for file in (made_up.ROOT / name).iterdir():
            if file.is_file():
                (tmp_path / name / file.name).write_bytes(file.read_bytes())
    (tmp_path / "results").mkdir()
    return tmp_path


def test_results_of_another_bundle_are_marked(repository):
    cells = [c for c in made_up.CELLS.values() if c.kind == "evaluate" and c.seed is None][:2]
    places = Places(made_up.ROOT, repository, repository)
    write_result(repository / "results", made_up.result_of(cells[0], key=cell_key(cells[0], places)))
    write_result(repository / "results", made_up.result_of(cells[1]))
    book = Book.open(repository / "results")
    assert book.changed == {cells[1].id: "older settings"}
    assert book.knows("ablations", "no-clock", "doggo") and not book.knows("ablations", "no-clock", "point")
    assert cells[1].id in render(book) and "makes them again" in render(book)


def test_results_of_an_older_bundle_say_so_in_their_cells_and_nothing_is_concluded_from_them(repository):
    places = Places(made_up.ROOT, repository, repository)
    now, older, plans = (
        made_up.CELLS[name]
        for name in ("table3/point-shipped-two-room", "table3/point-shipped-gremlin", "astar/point-astar-two-room")
    )
    failing = made_up.drive(np.random.default_rng(0), 1000) | {
        "reach_rate": 0.5, "reach_ci95": [0.47, 0.53], "endings": {"goal": 500, "fallen": 300, "timeout": 200},
    }  # fmt: skip
    before = {"bundle": now.bundle, "sha256": {}}
    for cell, changes in (
        (now, {"key": cell_key(now, places)}),
        (older, {"source": before}),
        (plans, {"source": before}),
    ):
        metrics = {"strict": failing | ({"reach_rate": 1.0, "reach_ci95": [0.99, 1.0]} if cell is plans else {})}
        write_result(repository / "results", made_up.result_of(cell, metrics=metrics, **changes))
    book = Book.open(repository / "results")
    assert book.changed == {older.id: "older bundle", plans.id: "older bundle"}
    shown = rows(tables.strict(book, "point"))
    assert all(text.endswith("older bundle") for text in shown["gremlin  ours, shipped bundle"])
    assert not any("older" in text for text in shown["two-room  ours, shipped bundle"])
    groups = [book.group("table3", "shipped", "point", world) for world in ("two-room", "gremlin")]
    assert ['class="met"' in tables.cell(group, "reach_rate", bar=0.4) for group in groups] == [True, False]
    assert told.shortfalls(book, "point") == [
        "two-room: 500 of 1000 episodes fail, 300 by lying on its back at the cap on steps, 200 by reaching the cap on "
        "steps. Whether the plans or the skill are the cause is not known: A* as planner was not run with this bundle."
    ]
    strict = next(f for f in told.findings(book) if "point, shipped" in f.target)
    assert strict.text.startswith(
        "missed: two-room (0.500); not run yet, or with older settings or an older bundle alone:"
    )
    assert "gremlin" in strict.text.partition("alone:")[2]
    assert "2 of 3 results are of older settings or an older bundle" in text_of(render(book))


def test_seeds_of_older_settings_are_counted_among_the_others(book):
    ids = [f"table3/doggo-ours-{seed}-gremlin" for seed in range(3)]
    mixed = replace(book, changed={ids[0]: "older settings"})
    assert mixed.group("table3", "ours", "doggo", "gremlin").age == "1 of 3: older settings"
    assert book.group("table3", "ours", "doggo", "gremlin").age == ""
    assert len(mixed.current().group("table3", "ours", "doggo", "gremlin").done) == 2


def test_the_worlds_that_all_columns_were_trained_in_are_told_and_unseen_ones_are_none_of_them(repository):
    book = Book.open(repository / "results")
    shown = rows(tables.training_worlds(book))
    assert shown["the paper, doggo"] == ["pillar(2,2,10)", "pillar(2,2,10)"]
    for robot in ROBOTS:
        config = load_config(made_up.ROOT / "configs" / f"{robot}.yaml")
        planner, skill = (row.split() for row in shown[f"ours, {robot}"])
        assert len(planner) == len(config.planner.worlds) and all(map(str.endswith, config.planner.worlds, planner))
        assert set(skill) == set(config.skill.worlds)
        assert set(WORLDS) <= set(planner) and not set(UNSEEN) & {*planner, *skill}
    told = " ".join(text_of(render(book)).split())
    assert "networks, its baseline too, were trained in pillar(2,2,10) alone" in told
    assert "How ours do in worlds that neither were trained in is under unseen worlds" in told
    assert tables.training_worlds(book) in render(book)


def test_what_no_experiment_holds_is_not_called_missing_and_who_is_trained_is_named(repository):
    book = Book.open(repository / "results")
    periods, ablations = _replanning(book).partition("Trained with")[2], _ablations(book).partition("In training")[2]
    assert "car: " in text_of(periods) and not re.search("(point|doggo): ", text_of(periods))
    assert not re.search("point: ", text_of(ablations))
    assert "The car is trained so; the paper trained the doggo." in text_of(periods)
    assert "The car is trained so, and in the place of it the doggo for: no cost of tilting;" in text_of(ablations)
    for named, cells in (("replanning", {"car"}), ("ablations", {"car", "doggo"})):
        trained = [c.robot for c in made_up.CELLS.values() if c.experiment == named and c.kind == "train"]
        assert set(trained) == cells


def test_what_the_baselines_reward_adds_to_the_papers_is_said(page):
    reward = load_config(None, ["skill.preset=baseline"]).reward
    assert {"leave_field", "tilt", "fall"} == {
        name for name in TERMS if getattr(reward, name) and name not in ("collision", "goal", "goal_distance")
    }
    assert "terms that the paper’s lacks: leaving the field, tilting and falling cost as well" in text_of(page)


def book_of(*results, planned=()):
    """A book of a repository that plans some cells."""
    return Book(Path(), list(results), [], cells=[made_up.CELLS[name] for name in planned])


def trained(robot, variant, seed, **changes):
    return made_up.result_of(made_up.CELLS[f"sample_efficiency/{robot}-{variant}-{seed}"], **changes)


FAILURE = {"state": "failed", "error": "TrainingDiverged: loss not finite", "metrics": {}, "curves": {}}


@pytest.mark.parametrize(
    ("last", "met", "text"),
    [
        (None, None, "not run yet: seed 2"),
        (FAILURE, False, "missed: seed 2 (failed)"),
        ({}, True, "met for 3 of 3 seeds"),
    ],
)
def test_the_steps_of_the_doggo_are_met_by_all_seeds_that_there_are_or_not_at_all(last, met, text):
    fast = {"evaluation": [{"step": 100_000.0, "reach_rate": 0.95}]}
    results = [trained("doggo", "ours", seed, curves=fast) for seed in (0, 1)]
    if last is not None:
        results.append(trained("doggo", "ours", 2, **{"curves": fast, **last}))
    found = told._doggo_steps(book_of(*results, planned=[f"sample_efficiency/doggo-ours-{s}" for s in range(3)]))
    assert found.met is met and text in found.text


@pytest.mark.parametrize(
    ("last", "met", "text"),
    [
        ({}, None, "not run yet: seed 1 of ours and the baseline"),
        ({"ours": {}}, None, "not run yet: seed 1 of the baseline"),
        ({"ours": FAILURE, "baseline": {}}, False, "missed: seed 1 (ours failed)"),
        ({"ours": {}, "baseline": FAILURE}, False, "missed: seed 1 (the baseline failed)"),
        ({"ours": {}, "baseline": {}}, True, "met for 2 of 2 seeds"),
    ],
)
def test_ours_is_above_the_baseline_for_all_seeds_that_there_are_or_not_at_all(last, met, text):
    def drives(variant, seed, **changes):
        result = trained("point", variant, seed)
        strict = result.metrics["strict"] | {"reach_rate": 0.9 if variant == "ours" else 0.8}
        return msgspec.structs.replace(result, **{"metrics": {"strict": strict}, **changes})

    results = [drives(variant, 0) for variant in ("ours", "baseline")]
    results += [drives(variant, 1, **changes) for variant, changes in last.items()]
    planned = [f"sample_efficiency/point-{variant}-{seed}" for variant in ("ours", "baseline") for seed in (0, 1)]
    found = told._above_baseline(book_of(*results, planned=planned), "point")
    assert found.met is met and text in found.text


@pytest.mark.parametrize(
    ("last", "met", "text"),
    [
        (None, None, "not run yet: 1,000 (seeds 2)"),
        (FAILURE, False, "missed: 1,000 (1 failed)"),
        ({}, True, "met for 4 of 4"),
    ],
)
def test_a_size_of_table_2_is_judged_when_all_its_seeds_are_there(last, met, text):
    planned = [name for name in made_up.CELLS if name.startswith("table2/default-")]
    results = []
    for name in planned:
        cell = made_up.CELLS[name]
        changes = {"metrics": {"samples": cell.settings["samples"], "collisions_mean": 0.5}}
        if name != "table2/default-1000-2":
            results.append(made_up.result_of(cell, **changes))
        elif last is not None:
            results.append(made_up.result_of(cell, **{**changes, **last}))
    found = told._table2(book_of(*results, planned=planned))
    assert found.met is met and text in found.text


def test_a_shipped_robot_whose_drive_failed_misses_its_target():
    cells = [made_up.CELLS[f"table3/point-shipped-{film_name(parse_world(world))}"] for world in WORLDS]
    good = {"strict": made_up.drive(np.random.default_rng(0), 1000) | {"reach_rate": 1.0}}
    results = [made_up.result_of(cell, metrics=good) for cell in cells[1:]]
    assert told._strict(book_of(*results), "point").met is None
    found = told._strict(book_of(*results, made_up.result_of(cells[0], **FAILURE)), "point")
    assert found.met is False and "missed: pillar(2,2,10) (failed)" in found.text


@pytest.mark.parametrize(
    ("finetuned", "seeds", "met", "text"),
    [
        ((0.985, 64.0), 0, True, "pillar(3,3,25) (shipped)"),  # reaches more, but slower
        ((0.985, 50.0), 0, True, "pillar(3,3,25) (shipped; shipped, fine-tuned)"),
        (None, 3, True, "pillar(3,3,25) (shipped; trained seeds)"),
    ],
)
def test_a_world_of_table_3_is_met_by_whichever_variant_meets_both_bars(finetuned, seeds, met, text):
    found = told._paper_table3(book_of(*table3_results((0.98, 55.0), finetuned, seeds), planned=TABLE3_PLANNED))
    assert found.met is met and text in found.text


def test_a_world_of_table_3_is_open_while_seeds_of_what_meets_it_are_missing():
    found = told._paper_table3(book_of(*table3_results(None, None, seeds=2), planned=TABLE3_PLANNED))
    assert found.met is None and "pillar(3,3,25) (seeds of trained seeds)" in found.text
    short = told._paper_table3(book_of(*table3_results((0.98, 64.0), (0.9, 50.0), 0), planned=TABLE3_PLANNED))
    assert short.met is False and "pillar(3,3,25) (shipped: 64.0 steps against 59.6" in short.text


TABLE3_PLANNED = [name for name in made_up.CELLS if name.startswith("table3/doggo-")]


def table3_results(shipped, finetuned, seeds):
    """Of the doggo: good ones in all worlds but pillar(3,3,25), where they reach and take as many steps as said."""
    results = []
    for name in TABLE3_PLANNED:
        cell = made_up.CELLS[name]
        given = {"shipped": shipped, "shipped-finetuned": finetuned, "ours": (1.0, 30.0)}.get(cell.variant)
        if cell.variant == "shipped" and cell.world != "pillar(3,3,25)":
            given = (1.0, 30.0)
        elif cell.world != "pillar(3,3,25)" or (cell.variant == "ours" and cell.seed >= seeds):
            continue
        if given is not None:
            drive = made_up.drive(np.random.default_rng(0), 200) | {"reach_rate": given[0], "steps_mean": given[1]}
            results.append(made_up.result_of(cell, metrics={"strict": drive, "paper": drive}))
    return results


def test_drives_that_do_not_differ_clearly_prove_nothing_about_the_planner():
    cells = [made_up.CELLS[f"{name}-gremlin"] for name in ("table3/car-shipped", "astar/car-astar")]
    drives = [
        made_up.drive(np.random.default_rng(0), 1000)
        | {
            "reach_rate": n / 1000,
            "reach_ci95": list(wilson_interval(n, 1000)),
            "endings": {"goal": n, "timeout": 1000 - n},
        }
        for n in (936, 958)
    ]
    results = [made_up.result_of(c, metrics={"strict": drive}) for c, drive in zip(cells, drives, strict=True)]
    (short,) = told.shortfalls(book_of(*results), "car")
    assert short.endswith("With A* plans it reaches 0.958, no clear difference.")


@pytest.mark.parametrize(
    ("ours", "astar", "told_of_it"),
    [(900, 990, "part of the cause is the learned planner."), (960, 900, "the learned planner is not the cause.")],
)
def test_drives_that_differ_clearly_tell_whether_the_planner_is_the_cause(ours, astar, told_of_it):
    results = []
    for name, reached in (("table3/car-shipped", ours), ("astar/car-astar", astar)):
        drive = made_up.drive(np.random.default_rng(0), 1000) | {
            "reach_rate": reached / 1000,
            "reach_ci95": list(wilson_interval(reached, 1000)),
            "endings": {"goal": reached, "timeout": 1000 - reached},
        }
        results.append(made_up.result_of(made_up.CELLS[f"{name}-gremlin"], metrics={"strict": drive}))
    (short,) = told.shortfalls(book_of(*results), "car")
    assert short.endswith(told_of_it)


@pytest.mark.parametrize(
    ("rate", "step", "met"), [(0.9, 500_000.0, True), (0.899, 1.0, False), (0.9, 500_001.0, False)]
)
def test_a_rate_and_a_number_of_steps_that_are_just_met_are_met(rate, step, met):
    points = [{"step": 0.5, "reach_rate": 0.1}, {"step": step, "reach_rate": rate}, {"step": 6e5, "reach_rate": 1.0}]
    result = trained("doggo", "ours", 0, curves={"evaluation": points})
    assert told.steps_to(result, 0.9) == (step if rate == 0.9 else 6e5)
    assert told._doggo_steps(book_of(result)).met is met


@pytest.mark.parametrize(("rate", "met"), [(told.STRICT_TARGET, True), (0.969, False)])
def test_a_strict_target_that_is_just_met_is_met(rate, met):
    drive = made_up.drive(np.random.default_rng(0), 1000) | {"reach_rate": rate}
    cells = [made_up.CELLS[f"table3/point-shipped-{film_name(parse_world(world))}"] for world in WORLDS]
    results = [made_up.result_of(cell, metrics={"strict": drive}) for cell in cells]
    assert told._strict(book_of(*results), "point").met is met


@pytest.mark.parametrize(
    ("name", "value", "met"),
    [
        ("reach_rate", 1.0, True),  # the paper's best of gremlin
        ("reach_rate", 0.995, False),
        ("steps_mean", 33.7, True),
        ("steps_mean", 33.8, False),
    ],
)
def test_a_number_is_marked_as_met_or_short_by_the_papers_best(name, value, met):
    drive = made_up.drive(np.random.default_rng(0), 200) | {name: value}
    shown = made_up.result_of(made_up.CELLS["table3/doggo-shipped-gremlin"], metrics={"paper": drive, "strict": drive})
    row = next(row for row in tables.table3(book_of(shown), "doggo", name).split("<tr>") if "gremlin" in row)
    assert (f'<span class="met">{value:.3f}' in row or f'<span class="met">{value:.1f}' in row) is met
    assert ('class="short"' in row) is not met


def with_reach(rate: float, steps: float = 30.0):
    """Made up results of which the doggo's shipped ones reach as often as said, in so many steps."""

    def change(cell):
        if (cell.experiment, cell.robot, cell.variant) != ("table3", "doggo", "shipped"):
            return None
        result = made_up.result_of(cell)
        reached = round(1000 * rate)
        changes = {"reach_rate": rate, "steps_mean": steps, "reach_ci95": [rate - 0.01, rate + 0.01],
                   "endings": {"goal": reached, "timeout": 1000 - reached}}  # fmt: skip
        metrics = {protocol: {**values, **changes} for protocol, values in result.metrics.items()}
        return msgspec.structs.replace(result, metrics=metrics)

    return change


@pytest.mark.parametrize(
    ("steps", "why"), [(50.0, "the skill falls short, whoever plans"), (30.0, "the learned planner is the cause")]
)
def test_what_a_star_reaches_says_why_the_paper_s_best_is_missed(tmp_path, steps, why):
    slow = with_reach(1.0, steps=90.0)

    def change(cell):
        if (cell.experiment, cell.robot) != ("astar", "doggo"):
            return slow(cell)
        result = made_up.result_of(cell)
        changes = {"reach_rate": 1.0, "steps_mean": steps}
        return msgspec.structs.replace(result, metrics={k: {**v, **changes} for k, v in result.metrics.items()})

    made_up.write_all(tmp_path / "results", change)
    text = told.findings(Book.open(tmp_path / "results"))[0].text
    assert f"with A* plans the shipped one reaches 1.000 in {steps:.1f} steps: {why}" in text


@pytest.mark.parametrize(("rate", "met"), [(1.0, True), (0.9, False)])
def test_targets_are_judged_by_the_numbers(tmp_path, rate, met):
    made_up.write_all(tmp_path / "results", with_reach(rate))
    book = Book.open(tmp_path / "results")
    by_target = {finding.target: finding for finding in told.findings(book)}
    first = next(f for target, f in by_target.items() if target.startswith("Every cell of Table III"))
    strict = next(f for target, f in by_target.items() if "doggo, shipped" in target)
    assert first.met is strict.met is met
    slow = with_reach(rate, steps=90.0)
    made_up.write_all(tmp_path / "slow", slow)
    text = told.findings(Book.open(tmp_path / "slow"))[0].text
    alone = (90.0 - (1.0 - rate) * 300) / rate  # of the episodes that reach the goal; the others count as the cap
    assert f"90.0 steps against 33.7, {alone:.1f} where it reaches the goal" in text
    short = told.shortfalls(book, "doggo")
    if met:
        assert not short and first.text.startswith("met for 5 of 5 worlds: gremlin (shipped), ")
    else:
        assert "gremlin (shipped: reach rate 0.900 against 1.00)" in first.text and "gremlin (0.900)" in strict.text
        assert short[0] == (
            "pillar(2,2,10): 100 of 1000 episodes fail, 100 by reaching the cap on steps. "
            "Whether the plans or the skill are the cause is not known: A* as planner was not run with this bundle."
        )


def test_the_page_is_written_whole(tmp_path):
    made_up.write_all(tmp_path / "results", with_reach(1.0))
    book = write_report(tmp_path / "results", tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert text.startswith("<!doctype html>") and text.endswith("</html>\n")
    assert len(book.results) == 6
    assert not list(tmp_path.glob("*.part"))


def test_each_target_is_said_to_be_met_missed_or_open(monkeypatch):
    judged = [told.Finding("a < b", True, "1 < 2"), told.Finding("b", False, "late"), told.Finding("c", None, "soon")]
    monkeypatch.setattr(report_page, "findings", lambda _: judged)
    items = re.findall(r"<li>.*?</li>", _targets(book_of()))
    assert [" ".join(text_of(item).split()) for item in items] == ["met a < b 1 < 2", "missed b late", "open c soon"]
    assert [re.findall(r'class="(\w+)"', item) for item in items] == [["met"], ["short"], ["none"]]


def test_the_worlds_in_which_a_shipped_robot_falls_short_stand_below_its_numbers(monkeypatch):
    monkeypatch.setattr(figures, "reach", lambda *_: None)
    half = {"reach_rate": 0.5, "endings": {"goal": 500, "timeout": 500}}
    drive = made_up.drive(np.random.default_rng(0), 1000) | half
    results = [
        made_up.result_of(made_up.CELLS[f"table3/{robot}-shipped-gremlin"], metrics={"strict": {**drive, **changes}})
        for robot, changes in (("car", {}), ("point", {"reach_rate": told.STRICT_TARGET}))
    ]
    shown = text_of(_strict(book_of(*results)))
    assert re.findall(r"Where the shipped (\w+) falls short of 0.97:", shown) == ["car"]
    assert "gremlin: 500 of 1000 episodes fail, 500 by reaching the cap on steps." in shown


def test_a_film_tells_how_many_episodes_reached_the_goal_and_a_failed_one_its_error():
    cells = [made_up.CELLS[f"films/point-{world}"] for world in ("gremlin", "two-room")]
    assert cells[0].settings["episodes"] != 2
    done, failed = made_up.result_of(cells[0]), made_up.result_of(cells[1], **{**FAILURE, "error": "no codec <h264>"})
    shown = text_of(_films(replace(book_of(done, failed), changed={done.id: "older bundle"}), Path()))
    assert f"point, gremlin: 2 of {cells[0].settings['episodes']} reached the goal (older bundle)" in shown
    assert "failed: no codec <h264> point, two-room" in " ".join(shown.split())


def test_done_failed_and_the_hours_of_both_are_counted_for_an_experiment():
    results = trained("point", "ours", 0, seconds=5400.0), trained("point", "ours", 1, seconds=1800.0, **FAILURE)
    assert rows(_provenance(book_of(*results)))["sample_efficiency"] == ["1", "1", "?", "2.00 h"]


def test_a_section_names_the_versions_of_the_code_that_made_it_and_no_others():
    results = [
        trained("point", "ours", 0, commit="0123456789abcdef", dirty=False),
        trained("point", "ours", 1, commit="0123456789abcdef", dirty=True),
        trained("point", "ours", 2, commit="0123456789abcdef", dirty=True),
        trained("point", "ours", 3, commit=None, dirty=None),
        made_up.result_of(made_up.CELLS["films/point-gremlin"], commit="fedcba9876543210"),
    ]
    told_of = text_of(_command(book_of(*results), "--only sample_efficiency"))
    assert "Made by 0123456 (1), 0123456 with changes (2), no repository (1)." in told_of
    assert "fedcba9" not in told_of


def test_a_robot_or_figure_that_was_not_run_is_named():
    shown = {"doggo": "1.0", "car": tables.NOT_RUN}
    tables_of = {robot: tables.table(["x"], [["a", cell]], "y") for robot, cell in shown.items()}
    told_of = " ".join(text_of(_by_robot(lambda robot: tables_of.get(robot, ""))).split())
    assert "car: not run yet" in told_of and "1.0" in told_of and "point" not in told_of
    gallery = _gallery([("<svg/>", "the doggo"), (None, "the car"), (None, "a <b>")])
    assert "not run yet: the car; a <b>" in text_of(gallery)


def test_a_page_that_cannot_be_replaced_stays_as_it_was(tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    out = tmp_path / "report.html"
    out.write_text("the page of before")

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(report_page, "render", lambda *_: "the page of now")
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space left"):
        patch.setattr("os.replace", full)
        write_report(tmp_path / "results", out)
    assert out.read_text() == "the page of before"
    write_report(tmp_path / "results", out)
    assert out.read_text() == "the page of now"
