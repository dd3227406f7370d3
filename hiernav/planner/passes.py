"""How long planners of Table II are trained, whatever the size of their data set; known without torch."""

from __future__ import annotations

BATCH, UPDATES, EPOCHS = 256, 1_000, 6
"""Every set is seen six times, and small ones until there were 1,000 updates."""


def epochs(samples: int) -> int:
    """Passes over so many samples."""
    return max(EPOCHS, -(-UPDATES * BATCH // samples))


def updates(samples: int) -> int:
    """Gradient updates in all of them."""
    return epochs(samples) * -(-samples // BATCH)
