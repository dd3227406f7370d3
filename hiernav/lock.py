"""One process at a time writes to a folder; who only reads asks nobody."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from weakref import WeakValueDictionary

try:
    import fcntl
except ImportError:  # no such locks here: nothing is locked
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""Empty file that stays in the folder; the lock is on it and ends with the process, however that ends."""


class _Held:
    def __init__(self, file: int) -> None:
        self.file = file

    def __del__(self, close: Callable[[int], None] = os.close) -> None:  # Python may have taken `os` away at its end
        close(self.file)


_held: WeakValueDictionary[Path, _Held] = WeakValueDictionary()
"""Locks that this process has: whoever works on a folder here may do so twice."""


def try_lock(file: int) -> bool:
    """Lock an open file until this process closes it; False if another has it. True where there are no locks."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            pass
    return True


class FolderLock:
    """A process's lock on a folder, from `acquire` to `release`, or as long as this object lives."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._held: _Held | None = None

    def acquire(self) -> bool:
        """Whether this process has the lock now; False if another one has it.

        Raises:
            OSError: the folder cannot be written to.
        """
        if self._held is None and fcntl is not None:  # else no file is made either
            folder = self.folder.resolve()
            self._held = _held.get(folder) or _lock(folder / LOCK)
            if self._held is None:
                return False
            _held[folder] = self._held
        return True

    def release(self) -> None:
        self._held = None


def _lock(file: Path) -> _Held | None:
    held = _Held(os.open(file, os.O_RDWR | os.O_CREAT, 0o666))  # not inherited by programs started here
    return held if try_lock(held.file) else None
