"""Claims about the documents: what they show of Python runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def snippets() -> list[str]:
    """Indented blocks of the README that begin with an import."""
    text = (ROOT / "README.md").read_text()
    blocks = re.findall(r"(?:^    .*\n|^\n(?=    ))+", text, re.MULTILINE)
    code = ["\n".join(line[4:] for line in block.strip("\n").split("\n")) for block in blocks]
    return [block for block in code if block.startswith(("import ", "from "))]


def test_there_are_snippets() -> None:
    assert len(snippets()) == 3


@pytest.mark.parametrize("code", snippets())
def test_a_snippet_of_the_readme_runs(code: str) -> None:
    command = [sys.executable, "-W", "error::DeprecationWarning:hiernav", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.returncode == 0, done.stderr
