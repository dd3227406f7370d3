"""Claims about printing to a reader that has stopped."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading

import pytest

from hiernav.runtime import patient
from hiernav.runtime.patient import PatientWriter


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    monkeypatch.setattr(PatientWriter, "hurried", False)
    monkeypatch.setattr(PatientWriter, "lost", False)


def ends(writer: PatientWriter, data: bytes) -> bool:
    """Whether a write does, in the time that a busy machine may need for it."""
    thread = threading.Thread(target=writer.write, args=(data,), daemon=True)
    thread.start()
    thread.join(30.0)
    return not thread.is_alive()


@pytest.mark.parametrize("faithful", [False, True])
def test_a_terminal_that_has_room_and_takes_nothing_is_given_up(monkeypatch, faithful):
    reader, end = os.pipe()
    writer, write = PatientWriter(end, faithful), os.write
    taken = [3]

    def stuck(descriptor: int, data: bytes) -> int:
        if descriptor == writer._target and not taken:
            raise BlockingIOError
        return write(descriptor, data[: taken.pop()] if descriptor == writer._target else data)

    monkeypatch.setattr(patient.os, "write", stuck)
    monkeypatch.setattr(PatientWriter, "hurried", True)
    assert ends(writer, b"something") and os.read(reader, 100) == b"som"
    assert PatientWriter.lost == faithful
    taken.append(100)
    assert ends(writer, b"more") and os.read(reader, 100) == b"more"
    os.close(reader)
    os.close(end)


def test_a_long_text_to_a_socket_that_nobody_reads_is_given_up():
    """As where a service manager takes what is printed: a socket cannot be opened anew as a pipe can."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert ends(PatientWriter(ours.fileno(), False), b"x" * 10_000_000)
        assert theirs.recv(100) == b"x" * 100


@pytest.mark.parametrize("buffered", ["", "1"])
def test_what_is_complained_about_is_told_at_once(buffered):
    program = (
        "import os, sys\nfrom hiernav.runtime.patient import be_patient\nbe_patient()\n"
        "print('complaint', file=sys.stderr)\nos._exit(0)\n"
    )
    environment = {**os.environ, "PYTHONUNBUFFERED": buffered}
    ended = subprocess.run([sys.executable, "-c", program], env=environment, stderr=subprocess.PIPE, timeout=120)
    assert ended.stderr == b"complaint\n"


def test_all_of_a_long_text_arrives_where_somebody_reads():
    reader, end = os.pipe()
    data, read = os.urandom(1_000_000), bytearray()
    writer = threading.Thread(target=PatientWriter(end, True).write, args=(data,), daemon=True)
    writer.start()
    while len(read) < len(data):
        read += os.read(reader, 65536)
    assert read == data
    writer.join(30.0)
    os.close(reader)
    os.close(end)
