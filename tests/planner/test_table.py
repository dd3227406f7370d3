"""Claims about entries of the waypoint generator's table: one that was interrupted goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="needs the extra hiernav[train]")

from hiernav.planner import store  # noqa: E402
from hiernav.planner import train as planner_train  # noqa: E402
from hiernav.planner.store import read_manifest  # noqa: E402
from hiernav.planner.table import measure  # noqa: E402

pytestmark = pytest.mark.train
SETTINGS = ("planner.samples_per_world=4", "planner.epochs=1", "planner.batch_size=8")


def entry(folder: Path, samples: int) -> dict:
    return measure(folder, samples, "paper", 0, world="pillar(1.2,1.2,2)", episodes=2, threads=1, settings=SETTINGS)


def test_an_entry_whose_data_set_was_interrupted_goes_on_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(store, "_SHARD_SAMPLES", 8)
    monkeypatch.setattr(planner_train, "_WALKS", 2)
    make_shard = store._make_shard

    def interrupted(*task):
        if task[3] == 1:
            raise KeyboardInterrupt
        return make_shard(*task)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store, "_make_shard", interrupted)
        entry(tmp_path, 24)
    (data,) = tmp_path.glob("data-paper-0-*")
    manifest = read_manifest(data)
    assert (manifest.samples, manifest.made) == (24, 8)
    assert entry(tmp_path, 24)["samples"] == 24
    assert read_manifest(data).finished


def test_an_entry_of_another_world_or_other_settings_has_a_planner_and_a_data_set_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(planner_train, "_WALKS", 2)

    def made(world: str, *settings: str) -> dict[str, set[str]]:
        before = set(tmp_path.iterdir())
        more = {"episodes": 2, "threads": 1, "settings": (*SETTINGS, *settings)}
        assert measure(tmp_path, 12, "paper", 0, world=world, **more)["world"] == world
        return {folder.name.partition("-")[0] for folder in set(tmp_path.iterdir()) - before}

    assert made("pillar(1.2,1.2,2)") == {"paper", "data"}
    assert made("two-room(1.2,1.2)") == {"paper", "data"}
    assert made("two-room(1.2,1.2)", "planner.epochs=2") == {"paper"}, "the same labels serve longer trainings"
    notes = {file: file.read_text() for file in tmp_path.glob("*/commits.txt")}
    assert len(notes) == 3
    monkeypatch.setattr("hiernav.run.package_state", lambda: ("another", False))
    assert made("two-room(1.2,1.2)") == set()
    assert {file: file.read_text() for file in notes} == notes, "it walked, and trained nothing"
