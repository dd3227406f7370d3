"""Replay buffer on disk: a torchrl ReplayBuffer over memory-mapped files, so that a checkpoint need not copy it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBuffer, TensorStorage

from hiernav.files import sync
from hiernav.nav.mirror import Mirror

KEYS = ("observation", "action", ("next", "observation"), ("next", "reward"), ("next", "done"), ("next", "terminated"))


class Replay:
    """Transitions of one run.

    `flush` puts all entries on disk, where they outlive a power failure; a trainer calls it before each checkpoint.
    What a crashed run wrote after the checkpoint is overwritten by the resumed one. (Once the buffer has wrapped, such
    entries can be sampled before they are overwritten; a run is only reproduced to the bit while `total_steps <=
    buffer_size`.)

    Raises OSError if the disk has no room for `size` transitions.

    Args:
        folder: of the files.
        size: transitions that it holds.
        observation: length of one.
        action: length of one.
        batch_size: transitions of a batch.
        device: that batches are drawn on; a GPU keeps a copy of all transitions.
    """

    def __init__(
        self,
        folder: Path,
        size: int,
        observation: int,
        action: int,
        batch_size: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._device = torch.device(device)
        self.fresh = not (folder / "meta.json").exists()
        """Whether its files were made just now, so that nothing is in them whatever a checkpoint says."""
        if not self.fresh:
            self._data = TensorDict.load_memmap(folder)
        else:
            example = TensorDict(
                {
                    "observation": torch.zeros(observation),
                    "action": torch.zeros(action),
                    "next": {
                        "observation": torch.zeros(observation),
                        "reward": torch.zeros(1),
                        "done": torch.zeros(1, dtype=torch.bool),
                        "terminated": torch.zeros(1, dtype=torch.bool),
                    },
                }
            )
            self._data = example.expand(size).memmap_like(folder)
            _reserve(folder)
        self._storage = TensorStorage(self._data)
        self._buffer = ReplayBuffer(storage=self._storage)
        self._batch_size = batch_size
        self._columns = {key: self._data[key].as_subclass(torch.Tensor) for key in KEYS}
        self._drawn_from = self._columns
        if self._device.type != "cpu":
            self._drawn_from = {key: torch.empty_like(c, device=self._device) for key, c in self._columns.items()}
        self._set(0, 0)

    def __len__(self) -> int:
        return len(self._buffer)

    def extend(self, transitions: TensorDict) -> None:
        """Append transitions (M,)."""
        places = self._buffer.extend(transitions.select(*KEYS))
        if self._drawn_from is not self._columns:
            places = places.to(self._device)
            for key, column in self._drawn_from.items():
                column[places] = transitions[key].to(self._device)

    def draw(self, batches: int) -> torch.Tensor:
        """Rows (batches, B) of random transitions, on the device."""
        return torch.randint(len(self), (batches, self._batch_size)).to(self._device)

    def batch(self, rows: torch.Tensor) -> TensorDict:
        """The transitions (B,) in those rows (B,), on the device.

        Taken here from the columns: the buffer's own way takes four times as long, and it would be run at every update.
        """
        drawn = {key: column.index_select(0, rows) for key, column in self._drawn_from.items()}
        following = {key[1]: drawn.pop(key) for key in KEYS if isinstance(key, tuple)}
        return TensorDict({**drawn, "next": TensorDict(following, [len(rows)])}, [len(rows)])

    def flush(self) -> None:
        """Wait until the files are on disk as they are now: the pages of the memory maps, their sizes and their names.

        Raises:
            OSError: the disk cannot take them.
        """
        for path in (*self._folder.rglob("*"), self._folder):
            sync(path)

    def state_dict(self) -> dict[str, int]:
        return {"cursor": int(self._buffer.writer.state_dict()["_cursor"]), "length": len(self)}

    def load_state_dict(self, state: dict[str, int]) -> None:
        self._set(state["cursor"], state["length"])

    def _set(self, cursor: int, length: int) -> None:
        # the files are the storage: only how much of them is valid has to be told
        self._storage._len = length
        self._buffer.writer.load_state_dict({"_cursor": cursor, "_write_count": length})
        if self._drawn_from is not self._columns:
            for key, column in self._drawn_from.items():
                column[:length] = self._columns[key][:length].to(self._device)


def _reserve(folder: Path) -> None:
    """Have the disk set the space of the files aside now: a page for which there is none left kills the process.

    Raises:
        OSError: there is not enough; the folder is removed.
    """
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        for file in folder.rglob("*.memmap"):
            with file.open("r+b") as opened:
                os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
    except OSError:
        shutil.rmtree(folder)
        raise


class HalfMirror:
    """Reflects the first half of a batch (B,) of transitions left to right, in place.

    Args:
        mirror: of the robot's observations and actions.
        device: of the batches.
    """

    def __init__(self, mirror: Mirror, device: torch.device | str = "cpu") -> None:
        sides = (mirror.observation_index, mirror.observation_sign), (mirror.action_index, mirror.action_sign)
        self._observation, self._action = (
            (torch.from_numpy(order).to(device), torch.from_numpy(sign).to(device)) for order, sign in sides
        )

    def __call__(self, batch: TensorDict) -> None:
        half = len(batch) // 2
        for values, (order, sign) in (
            (batch["observation"], self._observation),
            (batch["next", "observation"], self._observation),
            (batch["action"], self._action),
        ):
            values[:half] = values[:half].index_select(1, order).mul_(sign)
