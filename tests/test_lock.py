"""The lock on a folder, at the end of a program that has it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

# Modules that are still referred to at the end are emptied, those that were imported last first. So the module of the
# lock has lost its names before the lock itself is taken away.
PROGRAM = """
import json, sys
from pathlib import Path
from hiernav import lock
sys.kept = json, lock
json.kept = lock.FolderLock(Path(sys.argv[1]))
assert json.kept.acquire()
"""


def test_a_program_that_ends_with_a_lock_says_nothing(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
