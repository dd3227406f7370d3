"""Claims about films: they show what an evaluation drives, in its own time."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_run
from PIL import Image
from without_torch import BLOCK

from hiernav import cli
from hiernav.config import load_config
from hiernav.evaluate import Policies, evaluate
from hiernav.film import film as film_module
from hiernav.film.caption import LEAST_WIDTH, caption
from hiernav.film.film import FilmSettings, film_name, film_names, make_film
from hiernav.nav.termination import TerminationReason
from hiernav.sim.layout import parse_world
from hiernav.sim.rollout import Episode

WORLD = parse_world(tiny_run.WORLD)
SMALL = FilmSettings(size=200)
REPLANS = {reason.name.lower(): 0 for reason in TerminationReason}


def ahead(observation: np.ndarray) -> np.ndarray:
    """A skill that drives straight out of the field."""
    return np.tile([1.0, 0.0], (len(observation), 1))


@pytest.fixture(scope="module")
def policies() -> Policies:
    return Policies(load_config(None, ["robot=point"]), ahead, None)


def film(policies: Policies, path: Path, settings: FilmSettings = SMALL, episodes: int = 2) -> list[Episode]:
    return make_film(policies, WORLD, path, episodes=episodes, seed=5, planner="astar", settings=settings)


def seconds_of(path: Path) -> float:
    with Image.open(path) as shown:
        total = 0
        for number in range(shown.n_frames):
            shown.seek(number)
            total += shown.info["duration"]
    return total / 1000.0


def test_a_film_shows_the_episodes_an_evaluation_begins_with(policies, tmp_path):
    filmed = film(policies, tmp_path / "film.gif")
    measured: list[Episode] = []
    evaluate(
        policies,
        [WORLD],
        planner="astar",
        episodes=3,
        seed=5,
        rows=1,
        on_episode=lambda *ended: measured.append(ended[2]),
    )
    assert [(e.seed, e.steps, e.reason) for e in filmed] == [(e.seed, e.steps, e.reason) for e in measured[:2]]


@pytest.mark.parametrize(("speed", "fps", "expected"), [(1.0, None, 25.0), (0.25, None, 12.5), (2.0, 10.0, 10.0)])
def test_a_film_runs_at_its_speed_whatever_its_frame_rate(policies, tmp_path, speed, fps, expected):
    settings = FilmSettings(size=200, speed=speed, fps=fps)
    assert settings.frames_per_second(0.02) == expected
    episodes = film(policies, tmp_path / "film.gif", settings)
    # every episode stays for a second after its end
    driven = seconds_of(tmp_path / "film.gif") - len(episodes)
    assert abs(driven - sum(e.steps for e in episodes) * 0.02 / speed) <= len(episodes) / expected


def test_slow_motion_repeats_pictures_and_fast_motion_leaves_some_out(policies, tmp_path):
    drawn: list[int] = []

    class Counting(film_module.TopView):
        def frame(self, step):
            drawn.append(0)
            return super().frame(step)

    counts = []
    for settings in (FilmSettings(size=200, speed=0.5, fps=50.0), FilmSettings(size=200, speed=4.0, fps=25.0)):
        drawn.clear()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(film_module, "TopView", Counting)
            (episode,) = film(policies, tmp_path / "film.gif", settings, episodes=1)
        counts.append(len(drawn) - 1)  # without the one that shows the end
    assert counts[0] == episode.steps
    assert counts[1] == -(-episode.steps // 8)


@pytest.mark.parametrize(("setting", "value"), [("view", "side"), ("size", 10), ("fps", 0.5), ("speed", 101.5)])
def test_settings_out_of_range_are_named(setting, value):
    with pytest.raises(ValueError, match=f"{setting}.*{value}"):
        FilmSettings(**{setting: value})


def test_a_film_of_no_episodes_is_refused(policies, tmp_path):
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        film(policies, tmp_path / "film.gif", episodes=0)


@pytest.mark.parametrize(
    ("world", "name"),
    [("pillar(2,2,10)", "pillar-2-2-10"), ("pillar(1.2,3,4)", "pillar-1.2-3-4"), ("four-room", "four-room")],
)
def test_films_are_named_after_their_world(world, name):
    assert film_name(parse_world(world)) == name


def write_map(file: Path) -> Path:
    file.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(file.with_suffix(".png")), np.pad(np.full((60, 80), 254, np.uint8), 10))
    file.write_text(
        f"image: {file.stem}.png\n"
        "resolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    return file


def test_films_of_maps_are_named_after_the_maps_and_none_replaces_another(tmp_path):
    files = [write_map(tmp_path / name) for name in ("a/hall.yaml", "b/hall.yaml", "c/hall.yaml", "a/hall-2.yaml")]
    worlds = [parse_world(str(file)) for file in files]
    assert film_name(worlds[0]) == film_name(worlds[1]) == "map-hall"
    assert list(film_names(worlds).items()) == list(
        zip(worlds, ("map-hall", "map-hall-2", "map-hall-3", "map-hall-2-2"), strict=True)
    )


def test_the_caption_tells_how_an_episode_ended():
    episodes = [
        Episode(0, reason == "goal", reason, 9, 10, 0, 0.0, 1.0, 1.0, REPLANS, refused=0, recoveries=0)
        for reason in ("goal", "left_field", "timeout", "fallen", "physics")
    ]
    strips = [caption(LEAST_WIDTH, "world", "step 9", REPLANS, episode) for episode in (None, *episodes)]
    assert len({strip.tobytes() for strip in strips}) == 6
    assert len({strip.shape for strip in strips}) == 1


def test_the_text_fits_into_the_narrowest_caption():
    counts = dict.fromkeys(REPLANS, 99)
    strip = caption(LEAST_WIDTH, "pillar(4,4,40), seed 4294967295, astar planner, episode 10 of 10", "step", counts)
    assert (strip[:, -4:] == 255).all() and (strip[:, -60:] < 255).any()


@pytest.fixture
def bundle_film(able_bundle: Path, tmp_path: Path):
    """Runs `hiernav watch` on a bundle in a process of its own, where torch cannot be imported."""

    def run(*arguments: str, **environment: str) -> tuple[subprocess.CompletedProcess[str], Path]:
        path = tmp_path / "film.mp4"
        watch = ["watch", "--bundle", str(able_bundle), "--world", tiny_run.WORLD, "--episodes", "1", "--size", "200"]
        code = f"{BLOCK}\nfrom hiernav.cli import main\nsys.exit(main({[*watch, '--out', str(path), *arguments]!r}))"
        known = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "DISPLAY")}
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=known | environment
        )
        return done, path

    return run


@pytest.mark.train
def test_a_bundle_is_filmed_without_torch_beside_mujocos_own_view(bundle_film):
    done, path = bundle_film("--view", "mujoco", "--speed", "4")
    if done.returncode == 2 and "MuJoCo cannot draw" in done.stderr:
        pytest.skip("no OpenGL back end here")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{path}: 1 episodes, 1 reached the goal\n"
    video = cv2.VideoCapture(str(path))
    shown, picture = video.read()
    assert shown and picture.shape[1] == 400
    assert picture[:200, 200:].std() > 5.0  # something is to be seen there


@pytest.mark.train
def test_without_opengl_the_error_says_what_is_missing(bundle_film):
    done, path = bundle_film("--view", "mujoco", MUJOCO_GL="off")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "MuJoCo cannot draw with MUJOCO_GL=off" in done.stderr and "libegl1" in done.stderr
    assert "the view from above needs neither" in done.stderr
    assert not path.parent.exists() or list(path.parent.iterdir()) == []


def test_without_opengl_no_destructor_of_mujoco_adds_a_traceback_to_the_error(policies, tmp_path, monkeypatch):
    class Unmade:
        """As some releases: collected without what it would have had, were it made."""

        def __init__(self, *_: object) -> None:
            raise RuntimeError("no context")

        def __del__(self) -> None:
            self.free()

    unraisable: list[object] = []
    monkeypatch.setattr("mujoco.Renderer", Unmade)
    monkeypatch.setattr(sys, "unraisablehook", unraisable.append)
    hook = sys.unraisablehook
    with pytest.raises(ValueError, match="MuJoCo cannot draw .*no context"):
        film(policies, tmp_path / "film.gif", FilmSettings(view="mujoco", size=200))
    gc.collect()
    assert unraisable == [] and sys.unraisablehook is hook


@pytest.fixture
def run(able_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run folder, the only one in the present folder's runs/."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(able_run, "runs/able"))


@pytest.mark.train
def test_a_run_is_filmed_into_its_own_folder(run, capsys):
    arguments = ["watch", str(run), "--world", tiny_run.WORLD, "--world", "two-room(1.5,1.5)"]
    assert cli.main([*arguments, "--episodes", "1", "--size", "200", "--speed", "4"]) == 0
    films = [run / "films" / "pillar-1.2-1.2-2.mp4", run / "films" / "two-room-1.5-1.5.mp4"]
    assert sorted((run / "films").iterdir()) == films
    said = capsys.readouterr()
    assert [line.partition(": ")[0] for line in said.out.splitlines()] == [str(film) for film in films]
    assert "frames/s" in said.err


@pytest.mark.train
def test_maps_of_one_name_are_filmed_into_different_files(run, capsys, monkeypatch):
    worlds = [option for name in "ab" for option in ("--world", f"map({write_map(Path(name) / 'hall.yaml')})")]
    monkeypatch.setattr(film_module, "make_film", lambda *_, **__: [])
    assert cli.main(["watch", str(run), *worlds]) == 0
    films = [Path(line.partition(": ")[0]).stem for line in capsys.readouterr().out.splitlines()]
    assert films == ["map-hall", "map-hall-2"]


@pytest.mark.train
def test_the_newest_run_is_watched_and_the_shortest_path_plans_where_no_network_does_yet(run, capsys):
    (run / "planner" / "checkpoint.pt").unlink()
    assert cli.main(["watch", "--world", tiny_run.WORLD, "--episodes", "1", "--size", "200", "--out", "film.gif"]) == 0
    said = capsys.readouterr()
    assert said.out == "film.gif: 1 episodes, 1 reached the goal\n"
    assert "runs/able has no planner network yet: the shortest-path planner plans\n" in said.err


@pytest.mark.train
@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["runs/able", "--planner", "cnn"], "train the planner first, or use --planner astar"),
        (["runs/able", "--bundle", "bundle"], "a run and a bundle at once"),
        (["runs/able", "--world", "gremlin", "--world", "two-room", "--out", "a.mp4"], "a.mp4 is one film"),
        (["runs/able", "--out", "a.avi"], "--out a.avi: the name of a film must end in .mp4 or .gif"),
        (["runs/able", "--size", "9"], "size is 9, it must be 200 to 2000"),
        (["runs/able", "--episodes", "0"], "episodes must be at least 1, got 0"),
        (["runs/none"], "runs/none: no such folder"),
        (["--world", "maze"], "world 'maze': unknown"),
    ],
)
def test_what_cannot_be_filmed_is_refused_in_one_line(run, capsys, arguments, part):
    (run / "planner" / "checkpoint.pt").unlink()
    assert cli.main(["watch", *arguments]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("hiernav watch: ") and part in line
    assert not list(Path.cwd().rglob("*.mp4")) and not (run / "films").exists()
