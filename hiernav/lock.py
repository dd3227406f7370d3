"""One process at a time writes to a folder; who only reads asks nobody."""

from __future__ import annotations

import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # no such locks here: nothing is locked
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""Empty file that stays in the folder; the lock is on it and ends with the process, however that ends."""


class FolderLock:
    """Held from `acquire` to `release`, or as long as this object lives."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file: int | None = None

    def acquire(self) -> bool:
        """Whether the lock is held now; False if another holds it.

        Raises:
            OSError: the folder cannot be written to.
        """
        if self._file is not None or fcntl is None:
            return True
        file = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)  # not inherited by programs started here
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(file)
            return False
        except OSError:  # a file system without locks
            pass
        self._file = file
        return True

    def release(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def __del__(self) -> None:
        self.release()
