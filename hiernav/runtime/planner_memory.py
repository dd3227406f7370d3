"""What the control process and the planner's process share: questions, answers, map, visits, and how it is going."""

from __future__ import annotations

import json
import mmap
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hiernav.nav.occupancy import OccupancyMap, VisitMap
from hiernav.runtime.mailbox import Mailbox

_STATUS = struct.Struct("<qqqqq")
_SETUP = struct.Struct("<qqqq")  # capacity of a map [pixels], waypoints, bytes of settings, bytes of model
_MAP = struct.Struct("<QQQdddI")  # version, rows, columns, resolution, origin x and y, CRC-32 of the pixels
_QUESTION = struct.Struct("<QQ4d")  # number, version of the map, position, goal
_ANSWER = struct.Struct("<QQd512s")  # number of the question, start of the planner, time it took [s], counts as JSON


@dataclass(frozen=True)
class Status:
    """Of the process that makes plans."""

    pid: int
    """0 before the first start."""
    starts: int
    ready: int
    """The last start whose networks are loaded."""
    restarts: int
    exhausted: bool
    """Whether it has ended and will not be started again."""


@dataclass(frozen=True)
class Question:
    number: int
    position: np.ndarray
    goal: np.ndarray
    previous: np.ndarray
    """(K, 2)"""
    map_version: int


@dataclass(frozen=True)
class Reply:
    number: int
    plan: np.ndarray
    """(K, 2)"""
    seconds: float
    """That the planner took."""
    start: int
    """Of the planner: its first, its second..."""
    counts: Mapping[str, int] = field(default_factory=dict)
    """Of a planner that verifies its plans, since that start."""


class PlannerMemory:
    """A piece of shared memory with its parts. Every field has one process that writes it."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._memory = memory
        self.capacity, self.waypoints, settings, model = _SETUP.unpack_from(memory, _STATUS.size)
        points = 16 * self.waypoints
        at = _STATUS.size + _SETUP.size
        self._settings = slice(at, at + settings)
        self._model = slice(at + settings, at + settings + model)
        at = self._model.stop
        self._questions = Mailbox(memory, at, _QUESTION.size + points)
        at += Mailbox.size(_QUESTION.size + points)
        self._answers = Mailbox(memory, at, _ANSWER.size + points)
        at += Mailbox.size(_ANSWER.size + points)
        self._maps = [at, at + _MAP.size + self.capacity]
        self._visits = at + 2 * (_MAP.size + self.capacity)

    @staticmethod
    def size(capacity: int, waypoints: int, settings: bytes, model: bytes) -> int:
        """Bytes for maps of up to `capacity` pixels and plans of `waypoints`."""
        points = 16 * waypoints
        boxes = Mailbox.size(_QUESTION.size + points) + Mailbox.size(_ANSWER.size + points)
        return _STATUS.size + _SETUP.size + len(settings) + len(model) + boxes + 2 * _MAP.size + 3 * capacity

    @classmethod
    def create(cls, memory: mmap.mmap, capacity: int, waypoints: int, settings: bytes, model: bytes) -> PlannerMemory:
        """Lay out fresh memory of `size(...)` bytes."""
        _SETUP.pack_into(memory, _STATUS.size, capacity, waypoints, len(settings), len(model))
        made = cls(memory)
        memory[made._settings], memory[made._model] = settings, model
        return made

    def reopened(self) -> PlannerMemory:
        """The same memory, with its mailboxes as they are now."""
        return PlannerMemory(self._memory)

    @property
    def settings(self) -> bytes:
        """What the planner is made of, besides its network, as JSON."""
        return self._memory[self._settings]

    @property
    def model(self) -> bytes:
        """The network, the very bytes that were verified."""
        return self._memory[self._model]

    @property
    def status(self) -> Status:
        pid, starts, ready, restarts, exhausted = _STATUS.unpack_from(self._memory, 0)
        return Status(pid, starts, ready, restarts, bool(exhausted))

    def set_status(self, field: str, value: int) -> None:
        """Write one field of `Status`; each has one writer."""
        offset = 8 * ("pid", "starts", "ready", "restarts", "exhausted").index(field)
        struct.pack_into("<q", self._memory, offset, value)

    def ask(self, question: Question) -> None:
        head = _QUESTION.pack(question.number, question.map_version, *question.position, *question.goal)
        self._questions.put(head + np.ascontiguousarray(question.previous, np.float64).tobytes())

    def question(self) -> Question | None:
        """The newest question, if it has not been seen before."""
        message = self._questions.get()
        if message is None:
            return None
        number, version, x, y, goal_x, goal_y = _QUESTION.unpack_from(message)
        previous = np.frombuffer(message, np.float64, offset=_QUESTION.size).reshape(-1, 2)
        return Question(number, np.array([x, y]), np.array([goal_x, goal_y]), previous, version)

    def reply(self, reply: Reply) -> None:
        plan = np.ascontiguousarray(reply.plan, np.float64).tobytes()
        counts = json.dumps(reply.counts).encode()
        self._answers.put(_ANSWER.pack(reply.number, reply.start, reply.seconds, counts) + plan)

    def answer(self) -> Reply | None:
        """The newest reply, if it has not been seen before."""
        message = self._answers.get()
        if message is None:
            return None
        number, start, seconds, counts = _ANSWER.unpack_from(message)
        plan = np.frombuffer(message, np.float64, offset=_ANSWER.size).reshape(-1, 2)
        return Reply(number, plan, seconds, start, json.loads(counts.rstrip(b"\0")))

    def write_map(self, version: int, occupancy: OccupancyMap) -> None:
        """Leave a map for the questions that name its `version`, in the place of the last but one."""
        pixels = np.ascontiguousarray(occupancy.occupied).tobytes()
        if len(pixels) > self.capacity:
            raise ValueError(f"planner: map of {len(pixels)} pixels, memory was taken for {self.capacity}")
        place = self._maps[version % 2]
        head = (*occupancy.occupied.shape, occupancy.resolution, *occupancy.origin)
        _MAP.pack_into(self._memory, place, 0, *head, 0)
        self._memory[place + _MAP.size : place + _MAP.size + len(pixels)] = pixels
        _MAP.pack_into(self._memory, place, version, *head, zlib.crc32(pixels))

    def read_map(self, version: int) -> OccupancyMap | None:
        """The map of that version; None if it has been overwritten meanwhile."""
        place = self._maps[version % 2]
        found, rows, cols, resolution, x, y, checksum = _MAP.unpack_from(self._memory, place)
        if found != version or rows * cols > self.capacity:
            return None
        pixels = self._memory[place + _MAP.size : place + _MAP.size + rows * cols]
        if zlib.crc32(pixels) != checksum:
            return None
        return OccupancyMap(np.frombuffer(pixels, np.bool_).reshape(rows, cols), resolution, (x, y))

    def visits_of(self, visits: VisitMap) -> np.ndarray:
        """The memory in which a robot's visits are counted: uint8, in the shape of its map."""
        return self._counts(visits.counts.shape)

    def read_visits(self, occupancy: OccupancyMap) -> VisitMap:
        """The visits as they are now."""
        visits = VisitMap(occupancy)
        visits.counts = self._counts(occupancy.occupied.shape).copy()
        return visits

    def _counts(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.frombuffer(self._memory, np.uint8, shape[0] * shape[1], self._visits).reshape(shape)
