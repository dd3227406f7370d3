"""Data sets on disk: made shard by shard in several processes, resumable, and checked whenever they are read.

    dataset.json     format version, label settings, seed, number of samples; name, samples and SHA-256 of every shard
    shard-00000.npz  `image` (S, C, 64, 64) uint8, `distance` (S,) float32, `label` (S, K, 2) float32, as `Samples`
    .lock            empty; locked by the process that writes to the folder

Shard k holds the samples from k * (samples per shard) on of the seed's endless sequence, the one that `make_samples`
draws from: a data set can be made larger, and training on it is training on samples made for the run.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from hiernav.files import write_atomically
from hiernav.lock import LOCK, FolderLock
from hiernav.planner.dataset import LabelSettings, Samples, label_worlds, map_tasks

FORMAT_VERSION = 1
MANIFEST = "dataset.json"
_SHARD_SAMPLES = 2000
_COMPRESSION = 1  # of zlib: higher levels save a tenth and take five times as long


class DatasetError(ValueError):
    """A data set that cannot be used; the message names the folder or file and what does not fit."""


class Shard(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One file of samples."""

    file: str
    samples: int
    sha256: str


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a data set is, and how far it has been made."""

    format_version: int
    settings: LabelSettings
    seed: tuple[int, ...]
    samples: int
    """Wanted; all there once the shards' add up to it."""
    shards: tuple[Shard, ...]

    @property
    def made(self) -> int:
        """Samples that are there."""
        return sum(shard.samples for shard in self.shards)

    @property
    def finished(self) -> bool:
        return self.made == self.samples


def write_dataset(
    folder: str | Path,
    settings: LabelSettings,
    count: int,
    seed: tuple[int, ...],
    processes: int = 1,
    on_progress: Callable[[int], None] | None = None,
) -> Manifest:
    """Make a data set, or what is missing of it; a killed process loses the shards it was at.

    Args:
        on_progress: told the number of samples that are there.

    Raises:
        DatasetError: the folder holds a data set of another kind, one with more samples, or a damaged one, or another
            process writes to it.
        OSError: it cannot be written to.
        WorkersLost: see `map_tasks`.
    """
    folder, wanted = Path(folder), Manifest(FORMAT_VERSION, settings, seed, count, ())
    _begun(folder, wanted)  # before anything is written
    folder.mkdir(parents=True, exist_ok=True)
    lock = FolderLock(folder)
    if not lock.acquire():
        raise DatasetError(f"{folder} is in use: another process writes this data set; wait until it has ended")
    try:
        return _make_missing(folder, _begun(folder, wanted), processes, on_progress)
    finally:
        lock.release()


def _begun(folder: Path, wanted: Manifest) -> Manifest:
    """The wanted data set with what the folder has of it."""
    if (folder / MANIFEST).exists():
        there = read_manifest(folder)
        if not there.made:
            return wanted
        _require_compatible(folder, there, wanted)
        if wanted.samples < there.made:
            raise DatasetError(
                f"{folder} has {there.made:,} samples already, {wanted.samples:,} are wanted: choose another folder, "
                f"or train on the first of these with planner.samples={wanted.samples}"
            )
        return msgspec.structs.replace(there, samples=wanted.samples)
    if folder.is_file() or (folder.is_dir() and any(entry.name != LOCK for entry in folder.iterdir())):
        raise DatasetError(f"{folder} is not a data set and not empty: choose another folder")
    return wanted


def _make_missing(
    folder: Path, manifest: Manifest, processes: int, on_progress: Callable[[int], None] | None
) -> Manifest:
    settings, count = manifest.settings, manifest.samples
    worlds = -(-_SHARD_SAMPLES // settings.samples_per_world)
    size = worlds * settings.samples_per_world
    wanted = [min(size, count - first) for first in range(0, count, size)]
    # from the first shard on that is missing or shorter than it should be now
    kept = 0
    while kept < min(len(wanted), len(manifest.shards)) and manifest.shards[kept].samples == wanted[kept]:
        kept += 1
    shards = list(manifest.shards[:kept])
    tasks = [(folder, settings, manifest.seed, number, worlds, wanted[number]) for number in range(kept, len(wanted))]
    # before any shard is written: it names none that is about to be replaced, and shows whose the first ones are
    manifest = msgspec.structs.replace(manifest, shards=tuple(shards))
    _write_manifest(folder, manifest)
    done = manifest.made
    if on_progress is not None:
        on_progress(done)
    for shard in map_tasks(_make_shard, tasks, processes):
        shards.append(shard)
        done += shard.samples
        manifest = msgspec.structs.replace(manifest, shards=tuple(shards))
        _write_manifest(folder, manifest)
        if on_progress is not None:
            on_progress(done)
    return manifest


def read_manifest(folder: str | Path) -> Manifest:
    """What the data set in a folder says about itself.

    Raises:
        DatasetError: there is none, or it cannot be read.
    """
    file = Path(folder) / MANIFEST
    try:
        manifest = msgspec.json.decode(file.read_bytes(), type=Manifest)
    except OSError as error:
        raise DatasetError(
            f"{folder} is no data set ({MANIFEST}: {error.strerror}); `hiernav dataset` makes one"
        ) from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: {error}") from None
    if manifest.format_version != FORMAT_VERSION:
        raise DatasetError(f"{file}: format_version {manifest.format_version}, this hiernav reads {FORMAT_VERSION}")
    return manifest


def read_dataset(
    folder: str | Path, count: int | None = None, on_progress: Callable[[int], None] | None = None
) -> Samples:
    """The first `count` samples of a data set (all by default), every shard checked.

    Raises:
        DatasetError: it has fewer samples, is unfinished, or a shard is missing, altered or of other shapes.
    """
    manifest = read_manifest(folder)
    count = manifest.samples if count is None else count
    require_samples(folder, manifest, count)
    samples, done = Samples.empty(manifest.settings, count), 0
    for shard in manifest.shards:
        if done == count:
            break
        done += samples.store(done, _read_shard(Path(folder) / shard.file, shard, manifest.settings))
        if on_progress is not None:
            on_progress(done)
    return samples


def require_samples(folder: str | Path, manifest: Manifest, count: int) -> None:
    """Raise DatasetError unless so many samples are there."""
    if count > manifest.made:
        raise DatasetError(
            f"{folder} has {manifest.made:,} samples, {count:,} are wanted: let `hiernav dataset` go on with it"
        )


def _require_compatible(folder: Path, there: Manifest, wanted: Manifest) -> None:
    ours, theirs = (dataclasses.asdict(m.settings) | {"seed": m.seed} for m in (wanted, there))
    for name, value in ours.items():
        if value != theirs[name]:
            raise DatasetError(
                f"{folder} holds samples with {name} = {theirs[name]!r}, not {value!r}: choose another folder"
            )


def _make_shard(
    folder: Path, settings: LabelSettings, seed: tuple[int, ...], number: int, worlds: int, count: int
) -> Shard:
    needed = -(-count // settings.samples_per_world)
    samples = label_worlds(settings, seed, number * worlds, needed)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=_COMPRESSION) as archive:
        for name in Samples.__dataclass_fields__:
            with archive.open(f"{name}.npy", "w") as member:
                np.lib.format.write_array(member, getattr(samples, name)[:count], allow_pickle=False)
    file = f"shard-{number:05d}.npz"
    write_atomically(folder / file, buffer.getvalue())
    return Shard(file, count, hashlib.sha256(buffer.getbuffer()).hexdigest())


def _read_shard(file: Path, shard: Shard, settings: LabelSettings) -> Samples:
    try:
        data = file.read_bytes()
    except OSError as error:
        raise DatasetError(f"{file} cannot be read ({error.strerror}): make the data set anew") from None
    if hashlib.sha256(data).hexdigest() != shard.sha256:
        raise DatasetError(f"{file}: SHA-256 differs from {MANIFEST}; the file is truncated or altered")
    expected = Samples.empty(settings, 0)
    parts = {}
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            for name in Samples.__dataclass_fields__:
                parts[name] = arrays[name]
    except (KeyError, ValueError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{file}: {error}") from None
    for name, values in parts.items():
        like = getattr(expected, name)
        if values.shape != (shard.samples, *like.shape[1:]) or values.dtype != like.dtype:
            raise DatasetError(
                f"{file}: {name} is {values.dtype} {values.shape}, "
                f"expected {like.dtype} {(shard.samples, *like.shape[1:])}"
            )
        if values.dtype != np.uint8 and not np.isfinite(values).all():
            raise DatasetError(f"{file}: {name} is not finite everywhere")
    return Samples(**parts)


def _write_manifest(folder: Path, manifest: Manifest) -> None:
    write_atomically(folder / MANIFEST, msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")
