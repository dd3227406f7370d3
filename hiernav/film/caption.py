"""The strip of text under the picture."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hiernav.draw import COLLISION, EDGE, GOAL
from hiernav.film.top_view import REPLAN_COLORS, Frame
from hiernav.sim.rollout import Episode

LEAST_WIDTH = 400
"""The text needs so many pixels."""
_LINE, _MARGIN, _TEXT = 18, 8, 13
_ENDINGS = {
    "goal": "goal reached",
    "left_field": "left the field",
    "timeout": "ran out of steps",
    "fallen": "lay on its back",
    "physics": "physics not finite",
}


def caption(width: int, title: str, now: str, replans: Mapping[str, int], episode: Episode | None = None) -> Frame:
    """Three lines: what the film shows, where the episode is or how it ended, and what ended plans so far.

    Args:
        width: of the strip [pixels].
        replans: number of plans by reason, as in `Episode.replans`.
        episode: once it has ended.
    """
    image = Image.new("RGB", (width, 3 * _LINE + _MARGIN), "white")
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(_TEXT)
    draw.text((_MARGIN, 0), title, EDGE, font)
    if episode is not None:
        color = GOAL if episode.reached else COLLISION
        now = f"{_ENDINGS[episode.reason]} after {episode.steps} steps, {episode.collisions} with contact"
        draw.text((_MARGIN, _LINE), now, color, font, stroke_width=0.3)
    else:
        draw.text((_MARGIN, _LINE), now, EDGE, font)
    x = float(_MARGIN)
    for reason, color in REPLAN_COLORS.items():
        name, middle = reason.name.lower(), 2.5 * _LINE
        draw.polygon([(x, middle), (x + 5, middle - 5), (x + 10, middle), (x + 5, middle + 5)], color)
        text = f"{name} {replans[name]}"
        draw.text((x + 14, 2 * _LINE), text, EDGE, font)
        x += 14 + font.getlength(text) + 14
    return np.asarray(image)
