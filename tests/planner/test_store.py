"""Claims about data sets on disk: nothing is lost or made twice, and what is altered is not learnt from."""

from __future__ import annotations

import hashlib
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


def stopped_once_shard_is_written(number: int):
    """In the place of `_make_shard`: the process ends before the manifest names the shard."""
    make_shard = store._make_shard

    def stopped(*task):
        shard = make_shard(*task)
        if task[3] == number:
            raise KeyboardInterrupt
        return shard

    return stopped


def test_shards_that_no_manifest_names_yet_keep_nobody_from_going_on(tmp_path: Path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store, "_make_shard", stopped_once_shard_is_written(0))
        write_dataset(tmp_path / "data", SETTINGS, 8, SEED)
    other = replace(SETTINGS, radius=0.12)  # none of them is there, so any kind may be made
    for settings in (other, SETTINGS):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(store, "_make_shard", stopped_once_shard_is_written(0))
            write_dataset(tmp_path / "data", settings, 8, SEED)
    assert write_dataset(tmp_path / "data", SETTINGS, 8, SEED).finished
    assert same(read_dataset(tmp_path / "data"), make_samples(SETTINGS, 8, SEED))


def test_a_data_set_whose_enlarging_was_stopped_is_unfinished_and_not_altered(tmp_path: Path, monkeypatch):
    folder = tmp_path / "data"
    write_dataset(folder, SETTINGS, 12, SEED)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(store, "_make_shard", stopped_once_shard_is_written(1))
        write_dataset(folder, SETTINGS, 16, SEED)
    with pytest.raises(DatasetError, match=r"has 8 samples, 12 are wanted: let `hiernav dataset` go on"):
        read_dataset(folder, 12)
    write_dataset(folder, SETTINGS, 12, SEED)
    assert same(read_dataset(folder), make_samples(SETTINGS, 12, SEED))


def test_a_crash_while_a_file_is_replaced_leaves_the_old_one(folder: Path, monkeypatch):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}

    def crash(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("os.replace", crash)
        write_dataset(folder, SETTINGS, 30, SEED)
    assert before.items() <= {file.name: file.read_bytes() for file in folder.iterdir()}.items()
    assert len(read_dataset(folder)) == 20


def test_what_another_process_made_just_before_is_not_made_again(folder: Path, monkeypatch):
    acquire = store.FolderLock.acquire

    def late(lock: store.FolderLock) -> bool:
        with monkeypatch.context() as patch:
            patch.setattr(store.FolderLock, "acquire", acquire)
            write_dataset(folder, SETTINGS, 24, SEED)
        return acquire(lock)

    monkeypatch.setattr(store.FolderLock, "acquire", late)
    reported: list[int] = []
    write_dataset(folder, SETTINGS, 28, SEED, on_progress=reported.append)
    assert reported == [24, 28]


def test_shards_are_made_in_as_many_processes_as_are_asked_for(tmp_path: Path, monkeypatch):
    asked: list[int] = []

    def here(function, tasks, processes):
        asked.append(processes)
        return (function(*task) for task in tasks)

    monkeypatch.setattr(store, "map_tasks", here)
    write_dataset(tmp_path / "data", SETTINGS, 4, SEED, processes=3)
    assert asked == [3]


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
    assert [file.name for file in other.iterdir()] == ["thesis.txt"]
    with pytest.raises(DatasetError, match="not a data set and not empty"):
        write_dataset(other / "thesis.txt", SETTINGS, 20, SEED)


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


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda arrays: {**arrays, "label": arrays["label"][:, :9]}, r"label is float32 \(8, 9, 2\), expected "),
        (lambda arrays: {**arrays, "distance": arrays["distance"][:7]}, r"distance is float32 \(7,\), expected "),
        (lambda arrays: {**arrays, "image": arrays["image"].astype(np.int16)}, "image is int16 .*, expected uint8 "),
        (lambda arrays: {**arrays, "label": arrays["label"] * np.float32("nan")}, "label is not finite everywhere"),
        (lambda arrays: {name: arrays[name] for name in ("image", "label")}, "distance"),
        (lambda arrays: None, "shard-00001.npz: "),
    ],
    ids=["waypoints", "rows", "type", "nan", "part", "no archive"],
)
def test_a_shard_that_is_no_set_of_such_samples_is_named_though_its_hash_is_right(folder: Path, change, named: str):
    file = folder / "shard-00001.npz"
    with np.load(file) as arrays:
        changed = change(dict(arrays))
    file.write_bytes(b"PK, and no more") if changed is None else np.savez(file, **changed)
    manifest = json.loads((folder / "dataset.json").read_text())
    manifest["shards"][1]["sha256"] = hashlib.sha256(file.read_bytes()).hexdigest()
    (folder / "dataset.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match=named):
        read_dataset(folder)


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
