"""Claims about the documents: what they show of Python runs as it stands, and their tables say what the results say."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hiernav.report.paper import TABLE3, best_of_table3

ROOT = Path(__file__).parents[1]
ROBOTS = ("point", "car", "doggo")
NEEDS_TRAIN = re.compile(r"gymnasium|torchrl|hiernav\.training")


def driven(robot: str, world: str) -> dict[str, Any]:
    """What the shipped bundle did in a world, by the stricter protocol."""
    slug = re.sub(r"[(,]", "-", world).removesuffix(")")
    return json.loads((ROOT / "results" / "table3" / f"{robot}-shipped-{slug}.json").read_text())["metrics"]["strict"]


def rows(document: str, first: str) -> list[list[str]]:
    """Cells of the table whose header begins with a column."""
    lines = (ROOT / document).read_text().split("\n")
    begin = next(k for k, line in enumerate(lines) if line.startswith(f"| {first} |")) + 2
    end = next(k for k in range(begin, len(lines)) if not lines[k].startswith("|"))
    return [[cell.strip().strip("`") for cell in line.strip("|").split("|")] for line in lines[begin:end]]


def test_the_table_of_the_readme_says_what_the_results_say() -> None:
    table = rows("README.md", "world")
    assert {row[0] for row in table} == {"pillar(2,2,10)", *TABLE3}
    for world, *cells, paper in table:
        for robot, cell in zip(ROBOTS, cells, strict=True):
            found = driven(robot, world)
            assert cell == f"{found['reach_rate']:.3f}, {found['steps_mean']:.1f}, {found['collisions_mean']:.2f}"
        assert paper == ("{:.2f}, {:.0f}".format(*best_of_table3(world)) if world in TABLE3 else "")


def test_the_table_of_all_that_was_counted_says_what_the_results_say() -> None:
    table = rows("docs/results.md", "robot")
    assert [tuple(row[:2]) for row in table] == [
        (robot, world) for robot in ROBOTS for world in ("pillar(2,2,10)", *TABLE3)
    ]
    for robot, world, *cells in table:
        found = driven(robot, world)
        assert cells == [
            f"{found['reach_rate']:.3f}",
            "{:.3f} - {:.3f}".format(*found["reach_ci95"]),
            f"{found['steps_mean']:.1f}",
            f"{found['collisions_mean']:.2f}",
            f"{found['collision_free_rate']:.3f}",
            f"{found['spl_mean']:.3f}",
            f"{found['repairs']} of {found['proposals']}",
        ]


@pytest.mark.parametrize(
    "document",
    ["README.md", "SECURITY.md", "deploy/README.md", *(f"docs/{p.name}" for p in (ROOT / "docs").glob("*.md"))],
)
def test_links_of_the_documents_lead_somewhere(document: str) -> None:
    path = ROOT / document
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text())
    assert [link for link in links if "://" not in link and not (path.parent / link).exists()] == []


def snippets() -> list[str]:
    """Indented blocks of the README that begin with an import, and of the one that trains for minutes the imports."""
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"(?:^    .*\n|^\n(?=    ))+", text, re.MULTILINE)
    code = ["\n".join(line[4:] for line in block.strip("\n").split("\n")) for block in blocks]
    training = next(block for block in code if block.startswith("# what `hiernav train`"))
    trained = training.partition("\n\n")
    compile(trained[2], "README.md", "exec")
    return [trained[0], *(block for block in code if block.startswith(("import ", "from ")))]


def test_there_are_snippets() -> None:
    assert len(snippets()) == 5


@pytest.mark.parametrize(
    "code",
    [pytest.param(code, marks=[pytest.mark.train] if NEEDS_TRAIN.search(code) else []) for code in snippets()],
)
def test_a_snippet_of_the_readme_runs(code: str) -> None:
    command = [sys.executable, "-W", "error::DeprecationWarning:hiernav", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 0, done.stderr
