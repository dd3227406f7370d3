"""Bad input to a tool is one line on stderr and exit code 2, as with `hiernav`."""

from __future__ import annotations

import sys
from collections.abc import Callable

BAD_INPUT = 2


def exit_code(tool: str, main: Callable[[], int]) -> int:
    """Of `main`, or of what was wrong with its input."""
    try:
        return main()
    except (ValueError, OSError) as error:
        print(f"{tool}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
