"""The page: one HTML file that loads nothing, with figures and small films inside."""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path

from hiernav.files import write_atomically
from hiernav.nav.opencv import cv2
from hiernav.report import figures, paper, tables
from hiernav.report.book import Book
from hiernav.report.findings import findings, shortfalls
from hiernav.reproduce.experiments import ABLATED, DEPARTURE_WORLDS, EXPERIMENTS, OF_LEGS, ROBOTS, TABLE3_ROBOT, WORLDS
from hiernav.reproduce.results import Result

FILM_LIMIT = 120_000
"""Bytes of a film that is put into the page; a larger one is linked to."""
_RECOVERY = (
    "Ours and the baseline are not helped alike: a robot of ours that stands still gets a way out, in evaluations "
    "during training too (its worth is among the ablations: <i>a robot that stands still gets no way out</i>); "
    "this helps only a skill that follows waypoints, so the baseline never gets it."
)
_PREDICTION = (
    "In gremlin, our plans are made on the map as it will be 0.9 s later; in the paper, and when the skills that ship "
    "learned, on the map as it is (what it is worth is among the ablations: <i>plans are made on maps as they are</i>)."
)
_TYPES = {".mp4": "video/mp4", ".gif": "image/gif"}


def write_report(folder: Path, out: Path) -> Book:
    """Write the page of a folder of results; returns what was read.

    Raises:
        ValueError: there is no such folder.
    """
    book = Book.open(folder)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(out, render(book, out.parent).encode())
    return book


def render(book: Book, beside: Path = Path()) -> str:
    """The page as HTML; films that are linked to are named relative to the folder `beside`."""
    sections = [
        ("targets", "Targets", _targets(book)),
        ("table3", "Table III: six worlds", _table3(book)),
        ("strict", "Strict protocol", _strict(book)),
        ("table2", "Table II: planner against data", _table2(book)),
        ("unseen", "Unseen worlds", _unseen(book)),
        ("efficiency", "Sample efficiency", _efficiency(book)),
        ("replanning", "Replanning", _replanning(book)),
        ("ablations", "Our departures, one by one", _ablations(book)),
        ("films", "Films", _films(book, beside)),
        ("provenance", "Where the numbers come from", _provenance(book)),
    ]
    links = "".join(f'<a href="#{name}">{title}</a>' for name, title, _ in sections)
    body = "".join(f'<section id="{name}"><h2>{title}</h2>{text}</section>' for name, title, text in sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>hiernav: the paper, run again</title><style>{_CSS}</style></head><body><main>"
        "<h1>The paper, run again</h1>"
        "<p>Ota et al., <i>Efficient Exploration in Constrained Environments with Goal-Oriented Reference Path</i> "
        "(IROS 2020), and hiernav beside it. Ranges are 95 % intervals: over seeds Student’s t, over the episodes of "
        "one policy Wilson for rates and normal for means, cut to what is possible; of rates over seeds at least "
        "Wilson of all their episodes. A collision of a robot is a "
        "control step in which it touches an obstacle; there are 50 of them in a second of the point, 25 of the car "
        "and 10 of the doggo.</p>"
        f"<nav>{links}</nav>{_damaged(book)}{_older(book)}{body}</main></body></html>\n"
    )


def _targets(book: Book) -> str:
    words = {True: ("met", "met"), False: ("short", "missed"), None: ("none", "open")}
    items = [
        f'<li><span class="{words[found.met][0]}">{words[found.met][1]}</span> <b>{escape(found.target)}</b>'
        f"<br>{escape(found.text)}</li>"
        for found in findings(book)
    ]
    return f'<ul class="targets">{"".join(items)}</ul>'


def _table3(book: Book) -> str:
    parts = [
        "<p>The paper’s protocol: 200 episodes, a failure counts as the cap on steps, contacts with gremlins are not "
        "counted. Its table is of the doggo; <i>shipped</i> is the bundle in this repository; <i>trained</i> is the "
        "mean over seeds. Green: at or above the paper’s best of that row.</p>"
        "<p>The columns are not trained alike. The paper’s networks, its baseline too, were trained in "
        f"{paper.TRAINING_WORLD} alone, so that the other five worlds are new to them, until the planner is fine-tuned "
        "in each. Ours, <i>shipped</i> and <i>trained</i>, and our baseline have met most of these kinds of world in "
        "training, though not the layouts that they are tested in. How ours do in worlds that neither were trained in "
        f'is under <a href="#unseen">unseen worlds</a>.</p><p>{_RECOVERY} {_PREDICTION}</p>'
        + tables.training_worlds(book)
    ]
    for robot in reversed(ROBOTS):
        both = f"<h3>{robot}: reach rate</h3>{tables.table3(book, robot, 'reach_rate')}"
        both += f"<h3>{robot}: steps to the goal</h3>{tables.table3(book, robot, 'steps_mean')}"
        parts.append(both if robot == TABLE3_ROBOT else f"<details><summary>{robot}</summary>{both}</details>")
    return "".join(parts) + _command(book, "--only table3")


def _strict(book: Book) -> str:
    parts = [
        "<p>1000 episodes in layouts that no network has seen, most of kinds that ours were trained in; every contact "
        "counts, leaving the field is a failure. SPL is success weighted by shortest over driven length. The dotted "
        "line is the target of 0.97. A* in the place of the learned planner is not in the paper.</p>",
        f"<p>{escape(tables.redraws(book))}</p>",
        _gallery([(figures.reach(book, robot), f"{robot}: reach rate") for robot in reversed(ROBOTS)]),
        _command(book, "--only table3 astar"),
    ]
    for robot in reversed(ROBOTS):
        short = "".join(f"<li>{escape(text)}</li>" for text in shortfalls(book, robot))
        parts.append(f"<details><summary>{robot}: all numbers</summary>{tables.strict(book, robot)}</details>")
        if short:
            parts.append(f"<p>Where the shipped {robot} falls short of 0.97:</p><ul>{short}</ul>")
    return "".join(parts)


def _table2(book: Book) -> str:
    return (
        "<p>Collisions in an episode of a disc that walks along the waypoints, 1000 episodes in pillar(2,2,10); every "
        "waypoint that touches an obstacle counts 1. Plans are neither verified nor repaired, though of the six that "
        "<i>our network</i> proposes at once, one that is free on the map is taken if there is any. <i>Its network, "
        "ours</i> is the published network trained here. Every set is seen at least six times, and small ones until "
        "there were 1,000 updates of 256 samples: the largest set is more data and more updates at once. The paper "
        "does not tell its own.</p>"
        + _gallery([(figures.table2(book), "collisions of plans against samples")])
        + tables.table2(book)
        + _command(book, "--only table2")
    )


def _unseen(book: Book) -> str:
    return (
        "<p>Larger, denser and emptier worlds than any that our networks or the paper’s were trained in; neither "
        "planner nor skill is trained again. 200 episodes, strict. The paper has none of them.</p>"
        + _by_robot(lambda robot: tables.unseen(book, robot))
        + "<h3>Plans alone</h3><p>A disc of planning radius walks along the plans, without physics, 1000 times (200 in "
        "unseen worlds); moving obstacles are at rest. <i>Verified</i>: what the robots drive by, the network’s plans "
        "swept against the map and repaired where they collide or lead away.</p>"
        + _by_robot(lambda robot: tables.walks(book, robot))
        + _command(book, "--only walks unseen")
    )


def _efficiency(book: Book) -> str:
    names = {"reach_rate": "reach rate", "steps_mean": "steps to the goal", "return_mean": "return"}
    shown = [
        (figures.training(book, robot, name, label), f"{robot}: {label}")
        for robot in reversed(ROBOTS)
        for name, label in names.items()
    ]
    failed = [
        f"{r.robot} {v}, seed {r.seed}" for v in ("ours", "baseline") for r in book.group("sample_efficiency", v).failed
    ]
    return (
        "<p>Evaluations of the noiseless policy during training, in the worlds it is trained in. Thin lines are "
        "seeds, thick ones the mean of those that are of the settings of now. The baseline sees the goal in the place "
        "of waypoints, and its reward is the distance to the goal in the place of the path’s terms and of ours; all "
        "else is the same. Returns in the curves are by each one’s own reward and not to be compared; those in the "
        "table are of both by the baseline’s, as in the paper, except that here it has terms that the paper’s lacks: "
        "leaving the field, tilting and falling cost as well, the latter at every step on the back. Trainings by "
        "several versions of this library stand side by side: <i>code</i> names them. The paper’s own curves are "
        "printed without numbers; its networks of Table III were trained for "
        f"3,000,000 steps.</p><p>{_RECOVERY}</p>"
        + (f'<p class="short">Failed: {escape(", ".join(failed))}.</p>' if failed else "")
        + _gallery(shown)
        + "<p>In the end, 1000 strict episodes in pillar(2,2,10) with A* plans:</p>"
        + tables.sample_efficiency(book)
        + _command(book, "--only sample_efficiency")
    )


def _replanning(book: Book) -> str:
    return (
        "<p>The rule against fixed periods, with the bundles that ship; the paper’s rule planned every "
        f"{paper.STEPS_BETWEEN_PLANS} steps of the doggo (10 Hz; the car runs at 25 Hz, the point at 50 Hz). With a "
        "fixed period nothing else ends a plan; a robot that stands still gets a way out, and another plan behind it, "
        "under both.</p>"
        + _gallery([(figures.replanning(book, world), world) for world in DEPARTURE_WORLDS])
        + _by_robot(lambda robot: tables.replanning(book, robot))
        + "<h3>Trained with fixed periods, as in the paper</h3>"
        + f"<p>The {ABLATED} is trained so; the paper trained the doggo.</p>"
        + _by_robot(lambda robot: tables.trained_periods(book, robot))
        + _command(book, "--only replanning")
    )


def _ablations(book: Book) -> str:
    return (
        "<p>Each departure from the paper switched off (layer normalisation, learned plans and the "
        "world’s frame: switched on).</p>"
        "<h3>In driving</h3>" + _by_robot(lambda robot: tables.driving_ablations(book, robot)) + "<h3>In training</h3>"
        f"<p>The {ABLATED} is trained so, and in the place of it the {TABLE3_ROBOT} for: "
        + "; ".join(escape(tables.WHAT[name]) for name in OF_LEGS)
        + ". Driven with A* plans, 1000 strict episodes in pillar(2,2,10); returns by the baseline’s reward.</p>"
        + _by_robot(lambda robot: tables.trained_ablations(book, robot))
        + _command(book, "--only ablations")
    )


def _films(book: Book, beside: Path) -> str:
    shown = []
    for robot in ROBOTS:
        for world in WORLDS:
            group = book.group("films", "shipped", robot, world)
            for result in group.done:
                count, reached = result.settings.get("episodes"), result.metrics.get("reached")
                caption = f"{robot}, {world}: {reached} of {count} reached the goal"
                caption += f" ({group.age})" if group.age else ""
                shown.append((_film(book.folder / "films" / result.metrics["file"], beside), caption))
            shown += [
                (f'<p class="short">failed: {escape(r.error or "")}</p>', f"{robot}, {world}") for r in group.failed
            ]
            if not (group.done or group.failed):
                shown.append((None, f"{robot}, {world}"))
    return (
        "<p>The first episode of the strict protocol in each world, from above, three times as fast as it is; a tap "
        "plays and stops it.</p>" + _gallery(shown, "films") + _command(book, "--only films")
    )


def _film(path: Path, beside: Path) -> str | None:
    if path.suffix not in _TYPES or not path.is_file():
        return None
    if path.stat().st_size > FILM_LIMIT:
        link = path.resolve()
        if link.is_relative_to(beside.resolve()):
            link = link.relative_to(beside.resolve())
        return (
            f'<p><a href="{escape(link.as_posix())}">{escape(path.name)}</a> ({path.stat().st_size / 1e6:.1f} MB)</p>'
        )
    data = f"data:{_TYPES[path.suffix]};base64,{base64.b64encode(path.read_bytes()).decode()}"
    if path.suffix == ".gif":
        return f'<img alt="{escape(path.stem)}" src="{data}">'
    poster = _last_frame(path)
    play = "this.paused?this.play():this.pause()"
    return f'<video muted loop playsinline preload="none" onclick="{play}" poster="{poster}" src="{data}"></video>'


def _last_frame(path: Path) -> str:
    """How a film ends, the whole way in it, as the picture that stands for it; empty if it cannot be decoded."""
    video, last = cv2.VideoCapture(str(path)), None
    while (read := video.read())[0]:
        last = read[1]
    video.release()
    if last is None:
        return ""
    small = cv2.resize(last, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 50])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"


def _provenance(book: Book) -> str:
    results = book.results
    machines = sorted(
        {
            ", ".join([m.cpu, f"{m.cores} cores", *([m.gpu] if m.gpu else []), m.system])
            for m in (result.machine for result in results)
        }
    )
    versions = sorted({json.dumps(r.machine.versions, sort_keys=True) for r in results})
    failed = [r for r in results if r.state == "failed"]
    rows = []
    known = {result.id for result in results}
    for name in EXPERIMENTS:
        planned = [cell for cell in book.cells if cell.experiment == name]
        mine = [r for r in results if r.experiment == name]
        done, wrong = sum(r.state == "done" for r in mine), sum(r.state == "failed" for r in mine)
        hours = sum(r.seconds for r in mine) / 3600
        missing = str(sum(cell.id not in known for cell in planned)) if planned else "?"
        rows.append([name, str(done), str(wrong), missing, f"{hours:.2f} h"])
    parts = [
        "<p>Every number is from a file in <code>results/</code>, with its seed, commit, settings, machine, duration "
        "and the command that makes it.</p>",
        tables.table(["done", "failed", "not run yet", "took"], rows, "experiment"),
        f"<p>Commits: {_versions(results) or 'none'}. A result is made again when its settings or its bundle change, "
        "not when the code does: what stands in one table may be of several versions.</p>",
        "<p>Machines: " + escape("; ".join(machines) or "none") + ".</p>",
        *(f"<p><small>{escape(text)}</small></p>" for text in versions),
    ]
    if book.changed:
        items = "".join(f"<li>{escape(name)}: {what}</li>" for name, what in sorted(book.changed.items()))
        parts.append(f"<p>Of other settings or another bundle than the repository now holds; the queue makes them "
                     f"again:</p><ul>{items}</ul>")  # fmt: skip
    if failed:
        items = "".join(f"<li>{escape(r.id)}: {escape(r.error or '')}</li>" for r in failed)
        parts.append(f'<p class="short">Failed:</p><ul>{items}</ul>')
    return "".join(parts) + _command(book, "--list")


def _damaged(book: Book) -> str:
    if not book.damaged:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in book.damaged)
    return f'<p class="short">Result files that cannot be used:</p><ul>{items}</ul>'


def _older(book: Book) -> str:
    if not book.changed:
        return ""
    return (
        f"<p>{len(book.changed)} of {len(book.results)} results are of older settings or an older bundle than the "
        "repository now holds. Their cells say so, no text concludes from them, and figures show them as they are.</p>"
    )


def _by_robot(make: Callable[[str], str]) -> str:
    """A table for each robot that there is something to run of, folded up."""
    parts = []
    for robot in reversed(ROBOTS):
        text = make(robot)
        if not text:
            continue
        folded = f"<details><summary>{robot}</summary>{text}</details>"
        parts.append(f"<p>{robot}: {tables.NOT_RUN}</p>" if tables.is_empty(text) else folded)
    return "".join(parts)


def _gallery(shown: list[tuple[str | None, str]], kind: str = "figures") -> str:
    """Figures side by side where there is room."""
    parts = [f"<figure>{text}<figcaption>{escape(caption)}</figcaption></figure>" for text, caption in shown if text]
    missing = [caption for text, caption in shown if not text]
    note = f'<p class="none">not run yet: {escape("; ".join(missing))}</p>' if missing else ""
    if not shown:
        note = f"<p>{tables.NOT_RUN}</p>"
    return (f'<div class="{kind}">{"".join(parts)}</div>' if parts else "") + note


def _command(book: Book, options: str) -> str:
    """What makes a section, and which versions of the code made it so far."""
    made = [result for result in book.results if result.experiment in options.split()]
    code = f"<p><small>Made by {_versions(made)}.</small></p>" if made else ""
    return f"<p class=cmd><code>python tools/reproduce.py {escape(options)}</code></p>{code}"


def _versions(results: Sequence[Result]) -> str:
    """Commits with the number of results of each."""
    names = [(r.commit[:7] if r.commit else "no repository") + (" with changes" if r.dirty else "") for r in results]
    return escape(", ".join(f"{name} ({count})" for name, count in Counter(names).items()))


_CSS = """
:root{color-scheme:light dark;--ink:#1d2129;--paper:#fdfcfa;--soft:#6b7280;--line:#dcd9d2;--met:#1f7a4d;--short:#b3401a}
@media (prefers-color-scheme:dark){:root{--ink:#e6e4df;--paper:#16181c;--soft:#9aa0aa;--line:#343840;--met:#63c795;
--short:#f08a5d}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
main{max-width:72rem;margin:0 auto;padding:1rem}
h1{font-size:1.7rem;line-height:1.2;margin:.5rem 0}h2{margin:2.5rem 0 .5rem;border-bottom:1px solid var(--line)}
h3{margin:1.2rem 0 .3rem}p{max-width:46rem}
nav{display:flex;flex-wrap:wrap;gap:.3rem 1rem}a{color:inherit}
.wide{overflow-x:auto;max-width:100%;margin:.5rem 0}
table{border-collapse:collapse;font-size:.88rem;font-variant-numeric:tabular-nums}
th,td{padding:.35rem .7rem;border-bottom:1px solid var(--line);text-align:right;vertical-align:top;line-height:1.3}
td{white-space:nowrap}td.all{text-align:left}thead th{color:var(--soft);font-weight:600;vertical-align:bottom}
th:first-child{text-align:left;position:sticky;left:0;background:var(--paper)}
th[scope=row]{font-weight:500}
.targets{list-style:none;padding:0}.targets li{margin:.8rem 0;line-height:1.4}.theirs{color:var(--soft)}
small{color:var(--soft);font-weight:400}
.met{color:var(--met);font-weight:600}.short{color:var(--short);font-weight:600}.none{color:var(--soft);font-style:italic}
li{max-width:46rem}
.figures,.films{display:grid;gap:1rem;grid-template-columns:repeat(auto-fill,minmax(min(20rem,100%),1fr))}
.films{grid-template-columns:repeat(auto-fill,minmax(min(13rem,45%),1fr))}
figure{margin:0}video{cursor:pointer}figure svg,figure img,figure video{width:100%;height:auto;display:block}
svg text{font-family:system-ui,sans-serif!important}
figcaption{color:var(--soft);font-size:.85rem}
.cmd{overflow-x:auto}
code{font-size:.85rem;background:color-mix(in srgb,var(--line) 45%,transparent);padding:.15rem .4rem;border-radius:4px;
white-space:nowrap}
summary{cursor:pointer;margin:.6rem 0}
"""
