"""Bad input to a tool is one line on stderr and exit code 2, as with `hiernav`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

BAD_INPUT = 2


def exit_code(tool: str, main: Callable[[], int]) -> int:
    """That of `main`, or of bad input, which is told in one line."""
    try:
        return main()
    except (ValueError, OSError) as error:
        print(f"{tool}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT


def whole(least: int = 1) -> Callable[[str], int]:
    """Type of an option that takes whole numbers, none below `least`."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{value}, it must be at least {least}")
        return value

    return number


def number_from(least: float) -> Callable[[str], float]:
    """Type of an option that takes finite numbers, none below `least`."""

    def number(text: str) -> float:
        value = float(text)
        if not least <= value < math.inf:
            raise argparse.ArgumentTypeError(f"{text}, it must be finite and at least {least:g}")
        return value

    return number


def share(text: str) -> float:
    """Type of an option that takes numbers above 0, up to 1."""
    value = float(text)
    if not 0.0 < value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text}, it must be above 0 and at most 1")
    return value


def positive(text: str) -> float:
    """Type of an option that takes finite numbers above 0."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text}, it must be finite and above 0")
    return value
