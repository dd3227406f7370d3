"""Why options end, and the rule that tells it (paper section IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class TerminationReason(IntEnum):
    """Why a plan ended; NONE while it goes on."""

    NONE = 0
    START = 1
    D_UPDATE = 2
    HALF_INDEX = 3
    INVALID = 4
    GOAL = 5
    OUTDATED = 6


# Looking a member up takes longer than the comparison it is used in, and the robot does so at every tick.
_NONE, _START, _D_UPDATE, _HALF_INDEX, _INVALID, _GOAL, _OUTDATED = (int(reason) for reason in TerminationReason)


@dataclass(frozen=True)
class ReplanRule:
    """When an option ends: a rule without learned parts.

    If several conditions hold the first of `start`, `goal`, `invalid`, `d_update`, `half_index`, `outdated` is the
    reason.
    """

    d_update: float = 0.3
    """Distance to the closest waypoint above which the plan is given up [m]."""
    half_fraction: float = 0.5
    """Share of the waypoints behind the robot above which the plan is used up."""
    invalid: bool = True
    """Whether a plan is given up whose rest meets the map, or that is old and was made on another map (beyond
    the paper)."""
    period: int | None = None
    """Replan every so many steps instead of by distance and index (the paper's comparison)."""

    def __call__(
        self,
        distance: np.ndarray,
        index: np.ndarray,
        count: int,
        *,
        age: np.ndarray,
        blocked: np.ndarray,
        outdated: np.ndarray,
        at_goal: np.ndarray,
        started: np.ndarray,
    ) -> np.ndarray:
        """Termination reason of each row.

        Args:
            distance: (N,) to the closest waypoint [m]; NaN counts as too far.
            index: (N,) of the closest waypoint; 0 is the position the plan was made from.
            count: number of waypoints of a plan.
            age: (N,) control steps since the plan was made.
            blocked: (N,) bool, the remaining plan meets the map.
            outdated: (N,) bool, the plan is old and was made on another map; a fixed `period` is not cut short by it.
            at_goal: (N,) bool.
            started: (N,) bool, False before the first plan of an episode.

        Returns:
            (N,) int8 of `TerminationReason`.
        """
        if self.period is None:
            too_far = ~(distance <= self.d_update)
            used_up = index > self.half_fraction * count
        else:
            too_far, used_up = np.isnan(distance), age >= self.period
        reason = np.zeros(len(distance), dtype=np.int8)
        if not np.count_nonzero(used_up | too_far | blocked | outdated | at_goal | ~started):
            return reason
        # the last one that holds stays: from the least to the most important
        if self.invalid and self.period is None:
            reason[outdated] = _OUTDATED
        reason[used_up] = _HALF_INDEX
        reason[too_far] = _D_UPDATE
        if self.invalid:
            reason[blocked] = _INVALID
        reason[at_goal] = _GOAL
        reason[~started] = _START
        return reason
