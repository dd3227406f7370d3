"""Features of a path: nearest neighbour index, distance, progress (paper section IV-B).

A plan is turned into a polyline by prepending the position it was made from. Everything here is a pure function
of arrays, batch first, so that training, evaluation and robot share it.
"""

from __future__ import annotations

import numpy as np

_TINY = 1e-9


def polyline(start: np.ndarray, plan: np.ndarray) -> np.ndarray:
    """Prepend the position a plan was made from: (N, 2), (N, K, 2) -> (N, K + 1, 2)."""
    return np.concatenate([start[:, None, :], plan], axis=1)


def divide(line: np.ndarray, spacing: float) -> np.ndarray:
    """Divide polylines at regular intervals of arc length (paper Fig. 3).

    Args:
        line: (N, V, 2) vertices [m].
        spacing: distance between the new vertices along the line [m].

    Returns:
        (N, W, 2), where W fits the longest line; shorter ones repeat their last point, NaN lines stay NaN.
    """
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, got {spacing} m")
    arc = arc_lengths(line)
    count = int(np.floor(_longest(arc[:, -1]) / spacing + 1e-6)) + 2
    stations = np.minimum(np.arange(count) * spacing, arc[:, -1:])
    return point_at(line, stations, arc)


def arc_lengths(line: np.ndarray) -> np.ndarray:
    """Arc length from the first vertex to each vertex: (N, V, 2) -> (N, V) [m]."""
    arc = np.zeros(line.shape[:2])
    np.cumsum(_length(line[:, 1:] - line[:, :-1]), axis=1, out=arc[:, 1:])
    return arc


def point_at(line: np.ndarray, stations: np.ndarray, arc: np.ndarray | None = None) -> np.ndarray:
    """Points of polylines at given arc lengths, clamped to both ends.

    Args:
        line: (N, V, 2) vertices [m].
        stations: (N, S) arc lengths [m].
        arc: result of `arc_lengths(line)`, if already known.

    Returns:
        (N, S, 2) points [m].
    """
    arc = arc_lengths(line) if arc is None else arc
    segment = (arc[:, None, :] <= stations[:, :, None]).sum(-1) - 1
    segment = np.minimum(np.maximum(segment, 0), line.shape[1] - 2)
    rows = np.arange(len(line))[:, None]
    begin, length = arc[rows, segment], arc[rows, segment + 1] - arc[rows, segment]
    t = _unit((stations - begin) / np.maximum(length, _TINY))[..., None]
    return (1.0 - t) * line[rows, segment] + t * line[rows, segment + 1]


def nearest_vertex(points: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest neighbour index NNI and distance D of points to the vertices of their row.

    Args:
        points: (N, M, 2) [m].
        vertices: (N, V, 2) [m].

    Returns:
        index (N, M) of the first nearest vertex, distance (N, M) [m]; NaN points give a NaN distance.
    """
    squared = _squared(points[:, :, None, :] - vertices[:, None, :, :])
    return squared.argmin(-1), np.sqrt(squared.min(-1))


def distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(..., 2), (..., 2) -> (...) [m]; NaN where one is not known."""
    return np.sqrt(_squared(points - others))


def path_distance(before: np.ndarray, after: np.ndarray, vertices: np.ndarray, spacing: float) -> np.ndarray:
    """d_path: largest distance between the step's motion and the divided plan (paper section IV-B).

    Args:
        before, after: (N, 2) robot position at both ends of the control step [m].
        vertices: (N, V, 2) divided plan [m].
        spacing: at which the motion is divided [m].

    Returns:
        (N,) max over the motion of the distance to the closest plan vertex [m]; NaN where a row is NaN.
    """
    lengths = _length(after - before)
    # each row has its own number of pieces, and the last point again where others have more
    pieces = np.ceil(np.where(np.isfinite(lengths), lengths, 0.0) / spacing - 1e-9).clip(1.0)
    t = _unit(np.arange(pieces.max(initial=1.0) + 1.0) / pieces[:, None])[..., None]
    motion = (1.0 - t) * before[:, None, :] + t * after[:, None, :]
    return nearest_vertex(motion, vertices)[1].max(axis=1)


def signed_progress(points: np.ndarray, line: np.ndarray, lookahead: float = 0.5) -> np.ndarray:
    """How far along its polyline each point is, as the plan itself can vouch for.

    The largest of `arc length of p - distance to p` over the foot p of the point on the line and the vertices up to
    `lookahead` beyond it. On a straight line that is the arc length; behind the start it is negative, so backing away
    from a fresh plan costs what coming forward again pays; a step aside costs little more than the detour it is.

    The value is a function of position alone: over any closed motion its changes sum to zero. If the line is a shortest
    path it is also at most what the way to the goal has become shorter (triangle inequality), so not even a motion that
    provokes new plans on its way earns more than it came nearer to the goal. A path that keeps off obstacles is not a
    shortest one: with a lookahead, loops that provoke new plans may then earn some centimetres, which the cost of time
    has to outweigh.

    Args:
        points: (N, 2) [m].
        line: (N, V, 2) polyline [m].
        lookahead: short enough that a straight line to a vertex within it is as good as free [m].

    Returns:
        (N,) [m], at most the length of the line.
    """
    begin, edge = line[:, :-1], line[:, 1:] - line[:, :-1]
    squared = np.square(edge).sum(-1)
    t = ((points[:, None, :] - begin) * edge).sum(-1) / np.maximum(squared, _TINY)
    t = _unit(t)
    apart = np.square(points[:, None, :] - begin - t[..., None] * edge).sum(-1)
    rows, nearest = np.arange(len(line)), apart.argmin(-1)
    arc = arc_lengths(line)
    foot = arc[rows, nearest] + t[rows, nearest] * np.sqrt(squared[rows, nearest])
    ahead = arc - _length(points[:, None, :] - line)
    ahead[arc > foot[:, None] + lookahead] = -np.inf
    return np.maximum(foot - np.sqrt(apart[rows, nearest]), ahead.max(axis=1))


def _length(vectors: np.ndarray) -> np.ndarray:
    """Lengths of (..., 2): few rows are the rule here, and `np.linalg.norm` takes its time to begin."""
    return np.hypot(vectors[..., 0], vectors[..., 1])


def _squared(vectors: np.ndarray) -> np.ndarray:
    # of two components, a reduction takes longer to begin than to sum; what came in is not needed any more
    vectors *= vectors
    return vectors[..., 0] + vectors[..., 1]


def _unit(values: np.ndarray) -> np.ndarray:
    """Values clamped to [0, 1]; `np.clip` takes longer to begin."""
    return np.minimum(np.maximum(values, 0.0), 1.0)


def _longest(lengths: np.ndarray) -> float:
    # one robot whose position is lost must not keep the others from going on
    return float(np.max(lengths, initial=0.0, where=np.isfinite(lengths)))
