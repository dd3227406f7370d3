"""Which code a process runs, as git knows it."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

Code = tuple[str | None, bool | None]
"""The commit, and whether it is other code than that; None and None where there is no git."""

PATIENCE = 10.0
"""For git, which may wait for a disk that is not there [s]."""
_ELSEWHERE = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE")
"""By which git would look into another repository than asked for, as in a hook."""


def git_state(root: Path, apart: Sequence[Path] = ()) -> Code:
    """Commit of a repository and whether tracked files differ from it, those in the folders `apart` left out."""
    excluded = [f":(exclude){folder.relative_to(root)}" for folder in apart if folder.is_relative_to(root)]
    try:
        commit = _git(root, "rev-parse", "HEAD").strip()
        changes = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", *excluded)
    except (OSError, subprocess.SubprocessError):
        return None, None
    return commit, bool(changes.strip())


def package_state() -> Code:
    """As `git_state`, of the repository that this package is imported from.

    None and None where it is installed: a repository around that folder is somebody else's.
    """
    package = Path(__file__).resolve().parent
    try:
        _git(package, "ls-files", "--error-unmatch", Path(__file__).name)
    except (OSError, subprocess.SubprocessError):
        return None, None
    return git_state(package)


def code_differs(root: Path, before: str, after: str) -> bool:
    """Whether the package is not the same in two commits."""
    return before != after and bool(_git(root, "diff", "--name-only", before, after, "--", "hiernav").strip())


def code_name(code: Code) -> str:
    """ "0123abc...", "0123abc... with changes" or "no repository"."""
    commit, changed = code
    return f"{commit or 'no repository'}{' with changes' if changed else ''}"


def _git(root: Path, *arguments: str) -> str:
    # without a lock of the index, which would be in the way of somebody who commits
    command = ["git", "--no-optional-locks", "-C", str(root), *arguments]
    environment = {name: value for name, value in os.environ.items() if name not in _ELSEWHERE}
    done = subprocess.run(command, capture_output=True, check=True, timeout=PATIENCE, env=environment)
    return done.stdout.decode(errors="replace")
