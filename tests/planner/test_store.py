"""Claims about data sets on disk: nothing is lost or made twice, and what is altered is not learnt from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from locked import other_process

from hiernav import cli
from hiernav.planner import store
from hiernav.planner.dataset import LabelSettings, Samples, make_samples
from hiernav.planner.store import DatasetError, read_dataset, read_manifest, write_dataset

SETTINGS = LabelSettings(worlds=("pillar(1.2,1.2,2)", "gremlin(1.5,1.5,1)"), radius=0.1, soft_margin=0.1)
SETTINGS = replace(SETTINGS, samples_per_world=4)
SEED = (5, 4)


@pytest.fixture(autouse=True)
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_SHARD_SAMPLES", 8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_dataset(tmp_path / "data", SETTINGS, 20, SEED)
    return tmp_path / "data"


def same(a: Samples, b: Samples) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in Samples.__dataclass_fields__)


def test_what_is_read_is_what_training_would_have_made_itself(folder: Path):
    assert same(read_dataset(folder), make_samples(SETTINGS, 20, SEED))
    assert same(read_dataset(folder, 11), make_samples(SETTINGS, 11, SEED))
    manifest = read_manifest(folder)
    assert manifest.finished and manifest.settings == SETTINGS
    assert [shard.samples for shard in manifest.shards] == [8, 8, 4]


def test_a_data_set_is_smaller_than_its_samples(folder: Path):
    samples = read_dataset(folder)
    held = sum(file.stat().st_size for file in folder.glob("*.npz"))
    assert held < 0.5 * samples.image.nbytes


def test_an_interrupted_data_set_goes_on_where_it_was(tmp_path: Path, monkeypatch):
    make_shard, made = store._make_shard, []

    def interrupted(*task):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(task[3])
        return make_shard(*task)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store, "_make_shard", interrupted)
        write_dataset(tmp_path / "data", SETTINGS, 20, SEED)
    with pytest.raises(DatasetError, match=r"has 16 samples, 20 are wanted: let `hiernav dataset` go on"):
        read_dataset(tmp_path / "data")
    assert not read_manifest(tmp_path / "data").finished
    reported: list[int] = []
    write_dataset(tmp_path / "data", SETTINGS, 20, SEED, on_progress=reported.append)
    assert reported == [16, 20]
    assert same(read_dataset(tmp_path / "data"), make_samples(SETTINGS, 20, SEED))


def test_an_interrupted_data_set_is_whole_once_no_more_is_wanted(tmp_path: Path, monkeypatch):
    make_shard = store._make_shard

    def interrupted(*task):
        if task[3] == 2:
            raise KeyboardInterrupt
        return make_shard(*task)

    monkeypatch.setattr(store, "_make_shard", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "data", SETTINGS, 20, SEED)
    made = write_dataset(tmp_path / "data", SETTINGS, 16, SEED)
    assert made.finished and made == read_manifest(tmp_path / "data")
    assert same(read_dataset(tmp_path / "data"), make_samples(SETTINGS, 16, SEED))


def test_a_data_set_can_be_made_larger(folder: Path):
    reported: list[int] = []
    write_dataset(folder, SETTINGS, 30, SEED, on_progress=reported.append)
    assert reported == [16, 24, 30]  # the third shard was not full
    assert same(read_dataset(folder), make_samples(SETTINGS, 30, SEED))


@pytest.mark.parametrize("count", [16, 19, 8])
def test_samples_that_are_there_are_never_thrown_away(folder: Path, count: int):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(DatasetError, match=f"has 20 samples already, {count} are wanted"):
        write_dataset(folder, SETTINGS, count, SEED)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
    assert same(read_dataset(folder, count), make_samples(SETTINGS, count, SEED))  # as the message says
    assert write_dataset(folder, SETTINGS, 20, SEED).made == 20


def test_one_process_at_a_time_writes_to_a_data_set_and_others_read_it(folder: Path):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    with other_process(folder) as got:
        assert got
        with pytest.raises(DatasetError, match=r"data is in use: another process writes this data set; [^\n]*$"):
            write_dataset(folder, SETTINGS, 30, SEED)
        assert {file.name: file.read_bytes() for file in folder.iterdir()} == before
        assert len(read_dataset(folder)) == 20
    seen: list[bool] = []

    def look(_: int) -> None:
        with other_process(folder) as got:
            seen.append(got)

    write_dataset(folder, SETTINGS, 30, SEED, on_progress=look)
    assert seen == [False, False, False]
    with other_process(folder) as got:
        assert got


def test_a_data_set_that_was_stopped_at_its_first_shard_is_begun_again(tmp_path: Path, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store, "_make_shard", interrupted)
        write_dataset(tmp_path / "data", SETTINGS, 8, SEED)
    assert write_dataset(tmp_path / "data", SETTINGS, 8, SEED).finished


def test_samples_of_another_kind_are_not_mixed_in(folder: Path):
    with pytest.raises(DatasetError, match=r"radius = 0.1, not 0.2: choose another folder"):
        write_dataset(folder, replace(SETTINGS, radius=0.2), 20, SEED)
    with pytest.raises(DatasetError, match="seed"):
        write_dataset(folder, SETTINGS, 20, (6, 4))
    other = folder.with_name("other")
    other.mkdir()
    (other / "thesis.txt").write_text("mine")
    with pytest.raises(DatasetError, match="not a data set and not empty"):
        write_dataset(other, SETTINGS, 20, SEED)


def altered(file: Path) -> None:
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (lambda f: altered(f / "shard-00001.npz"), "shard-00001.npz: SHA-256 differs"),
        (lambda f: (f / "shard-00001.npz").unlink(), "shard-00001.npz cannot be read"),
        (lambda f: (f / "dataset.json").unlink(), "is no data set"),
        (lambda f: (f / "dataset.json").write_text("{"), "dataset.json: "),
        (
            lambda f: (f / "dataset.json").write_text((f / "dataset.json").read_text().replace(": 1,", ": 9,", 1)),
            "format_version 9",
        ),
    ],
    ids=["altered", "missing", "no manifest", "half a manifest", "newer format"],
)
def test_what_is_altered_or_missing_is_not_learnt_from(folder: Path, damage, named: str):
    damage(folder)
    with pytest.raises(DatasetError) as error:
        read_dataset(folder)
    assert named in str(error.value)


def test_the_command_makes_goes_on_checks_and_draws(tmp_path: Path, capsys):
    folder, sheet = tmp_path / "data", tmp_path / "sheet.png"
    arguments = [
        "dataset",
        "--out",
        str(folder),
        "--world",
        "2*pillar(1..1.5,1.2,1..3)",
        "--world",
        "gremlin(1.5,1.5,1)",
    ]
    arguments += ["--json", "planner.samples_per_world=4"]
    assert cli.main([*arguments, "planner.samples=10"]) == 0
    assert json.loads(capsys.readouterr().out)["made"] == 10
    assert cli.main(["dataset", "--sheet", str(sheet), "--samples", "18", *arguments[1:]]) == 0
    assert json.loads(capsys.readouterr().out)["made"] == 10  # the unfinished shard anew
    assert sheet.read_bytes().startswith(b"\x89PNG")
    assert cli.main(["dataset", "--out", str(folder), "--check"]) == 0
    assert "18 samples" in capsys.readouterr().out
    altered(folder / "shard-00000.npz")
    assert cli.main(["dataset", "--out", str(folder), "--check"]) == 2
    assert "SHA-256" in capsys.readouterr().err
