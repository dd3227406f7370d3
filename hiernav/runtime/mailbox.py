"""Memory shared by two processes, and in it mailboxes that hold the newest message and never make anybody wait."""

from __future__ import annotations

import mmap
import os
import struct
import tempfile
import zlib

_HEADER = struct.Struct("<QII")  # number of the message, its length, CRC-32 over number and message
_NUMBER = struct.Struct("<Q")


def shared_memory(size: int) -> int:
    """A file descriptor of `size` bytes of memory, for `mmap` here and in a process that inherits it."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("hiernav", 0)
    else:  # not Linux: a file that nobody else can open
        descriptor, path = tempfile.mkstemp()
        os.unlink(path)
    os.ftruncate(descriptor, size)
    return descriptor


def mapped(descriptor: int) -> mmap.mmap:
    """The memory of a descriptor from `shared_memory`."""
    return mmap.mmap(descriptor, os.fstat(descriptor).st_size)


class Mailbox:
    """Carries the newest message from one writer to one reader; older ones are lost.

    Neither side takes a lock, so that a process which dies or stands still in the middle of an access harms nobody.
    Two places are written in turn, and a message counts only if its checksum is right: one that is overwritten while
    it is read, or was never finished, is as good as none.
    """

    def __init__(self, memory: mmap.mmap, offset: int, capacity: int) -> None:
        """Use `size(capacity)` bytes of `memory` from `offset` on, for messages of up to `capacity` bytes."""
        self.capacity = capacity
        self._memory = memory
        self._places = [offset, offset + _HEADER.size + capacity]
        self._written = max(self._number(place) for place in self._places)
        self._read = 0

    @property
    def written(self) -> int:
        """Number of the newest message that was put."""
        return self._written

    @property
    def taken(self) -> int:
        """Number of the newest message that was got."""
        return self._read

    @staticmethod
    def size(capacity: int) -> int:
        """Bytes of memory that a mailbox takes."""
        return 2 * (_HEADER.size + capacity)

    def put(self, message: bytes) -> None:
        """Leave a message in the place of the older one of the last two.

        Raises:
            ValueError: longer than the capacity.
        """
        if len(message) > self.capacity:
            raise ValueError(f"Mailbox: message of {len(message)} bytes, the limit is {self.capacity}")
        number = self._written = self._written + 1
        place = self._places[number % 2]
        memory, body = self._memory, place + _HEADER.size
        _HEADER.pack_into(memory, place, 0, 0, 0)
        memory[body : body + len(message)] = message
        _HEADER.pack_into(memory, place, number, len(message), _checksum(number, message))

    def get(self) -> bytes | None:
        """The newest message, if it has not been got before."""
        first, second = self._places
        places = (first, second) if self._number(first) > self._number(second) else (second, first)
        for place in places:
            number, length, checksum = _HEADER.unpack_from(self._memory, place)
            if number <= self._read or length > self.capacity:
                continue
            message = self._memory[place + _HEADER.size : place + _HEADER.size + length]
            if _checksum(number, message) == checksum:
                self._read = number
                return message
        return None

    def _number(self, place: int) -> int:
        return int(_NUMBER.unpack_from(self._memory, place)[0])


def _checksum(number: int, message: bytes) -> int:
    return zlib.crc32(message, zlib.crc32(_NUMBER.pack(number)))
