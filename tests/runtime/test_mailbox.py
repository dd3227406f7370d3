"""Claims about mailboxes: the newest message or none, and never half of one."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hiernav.runtime.mailbox import Mailbox, mapped, shared_memory


def boxes(capacity: int = 64) -> tuple[Mailbox, Mailbox]:
    """Both sides of a mailbox, through separate mappings of the same memory."""
    descriptor = shared_memory(Mailbox.size(capacity))
    sides = Mailbox(mapped(descriptor), 0, capacity), Mailbox(mapped(descriptor), 0, capacity)
    os.close(descriptor)
    return sides


def test_only_the_newest_message_is_found_and_only_once():
    writer, reader = boxes()
    assert reader.get() is None
    for text in (b"one", b"two", b"three"):
        writer.put(text)
    assert reader.get() == b"three" and reader.get() is None
    writer.put(b"")
    assert reader.get() == b""


@given(st.lists(st.one_of(st.none(), st.binary(max_size=64)), max_size=60))
def test_whatever_is_written_and_read_in_turns_the_newest_unread_comes_out(steps):
    writer, reader = boxes()
    newest = None
    for step in steps:
        if step is None:
            assert reader.get() == newest
            newest = None
        else:
            writer.put(step)
            newest = step


@given(st.integers(0, 200), st.integers(0, 255))
def test_a_torn_message_is_as_good_as_none(offset, value):
    writer, reader = boxes()
    writer.put(b"a" * 64)
    first = reader.get()
    writer.put(b"b" * 64)
    memory = writer._memory
    at = offset % len(memory)
    memory[at] = value
    assert first == b"a" * 64 and reader.get() in (None, b"b" * 64)


def test_a_writer_that_comes_back_goes_on_where_the_last_one_ended():
    writer, reader = boxes()
    for _ in range(5):
        writer.put(b"old")
    assert reader.get() == b"old"
    again = Mailbox(writer._memory, 0, 64)
    again.put(b"new")
    assert reader.get() == b"new"


def test_a_message_that_does_not_fit_is_refused():
    writer, _ = boxes(8)
    with pytest.raises(ValueError, match="message of 9 bytes, the limit is 8"):
        writer.put(bytes(9))
