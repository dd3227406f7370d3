"""Which code a process runs, as git knows it."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

Code = tuple[str | None, bool | None]
"""The commit, and whether it is other code than that; None and None where there is no git."""


def git_state(root: Path, apart: Sequence[Path] = ()) -> Code:
    """Commit of a repository and whether tracked files differ from it, those in the folders `apart` left out."""
    excluded = [f":(exclude){folder.relative_to(root)}" for folder in apart if folder.is_relative_to(root)]
    try:
        commit = _git(root, "rev-parse", "HEAD").strip()
        changes = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", *excluded)
    except (OSError, subprocess.CalledProcessError):
        return None, None
    return commit, bool(changes.strip())


def package_state() -> Code:
    """As `git_state`, of the repository that this package is imported from.

    None and None where it is installed: a repository around that folder is somebody else's.
    """
    package = Path(__file__).resolve().parent
    try:
        _git(package, "ls-files", "--error-unmatch", Path(__file__).name)
    except (OSError, subprocess.CalledProcessError):
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
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
    return done.stdout
