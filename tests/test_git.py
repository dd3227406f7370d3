"""Which code trained: a commit that is this package's, and none that is only around it."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hiernav.git import code_name

ROOT = Path(__file__).parents[1]


@pytest.fixture
def repository(tmp_path):
    """A repository in which nothing but this package's two files is known to git, and how to ask git there."""
    for name in ("__init__.py", "git.py"):
        (tmp_path / "hiernav").mkdir(exist_ok=True)
        shutil.copy(ROOT / "hiernav" / name, tmp_path / "hiernav" / name)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c", *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "x")
    return tmp_path, git


def told(folder: Path, **environment: str) -> str:
    """What the package in `folder` says of itself, from elsewhere."""
    script = "from hiernav.git import code_name, package_state; print(code_name(package_state()))"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd="/", env={**os.environ, "PYTHONPATH": str(folder), **environment},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    return done.stdout.strip()


def test_a_package_in_its_repository_tells_the_commit_and_changes(repository):
    folder, git = repository
    assert told(folder) == git("rev-parse", "HEAD")
    (folder / "notes.txt").write_text("not tracked")
    assert told(folder) == git("rev-parse", "HEAD")
    with (folder / "hiernav" / "git.py").open("a") as file:
        file.write("\n")
    assert told(folder) == f"{git('rev-parse', 'HEAD')} with changes"


def test_a_package_installed_inside_another_repository_does_not_tell_its_commit(repository):
    folder, _ = repository
    installed = folder / ".venv" / "lib"
    installed.mkdir(parents=True)
    shutil.copytree(folder / "hiernav", installed / "hiernav")
    assert told(installed) == "no repository"


def test_neither_a_hook_of_another_repository_nor_a_file_of_any_name_is_in_the_way(repository, tmp_path_factory):
    folder, git = repository
    other = tmp_path_factory.mktemp("other")
    subprocess.run(["git", "init", "-q", str(other)], check=True)
    assert told(folder, GIT_DIR=str(other / ".git"), GIT_WORK_TREE=str(other)) == git("rev-parse", "HEAD")
    git("config", "core.quotepath", "false")
    name = os.fsencode(folder / "hiernav") + b"/caf\xe9.txt"
    for text in (b"1", b"2"):
        with open(name, "wb") as file:
            file.write(text)
        if text == b"1":
            git("add", ".")
            git("commit", "-q", "-m", "y")
    assert told(folder) == f"{git('rev-parse', 'HEAD')} with changes"


def test_a_code_is_named_also_where_it_is_not_known():
    assert code_name((None, None)) == "no repository" and code_name(("abc", True)) == "abc with changes"
