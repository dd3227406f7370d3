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
    monkeypatch.setattr(PatientWriter, "why", "")


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


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs Linux's /dev/full")
@pytest.mark.parametrize("faithful", [False, True])
def test_a_report_that_a_full_disk_does_not_take_is_lost_and_the_reason_kept(faithful):
    with open("/dev/full", "wb", buffering=0) as full, pytest.raises(OSError, match="No space left"):
        PatientWriter(full.fileno(), faithful).write(b"x")
    assert (PatientWriter.lost, PatientWriter.why) == (faithful, "No space left on device" if faithful else "")


def test_a_report_that_nobody_wants_to_read_any_more_is_not_lost():
    reader, end = os.pipe()
    os.close(reader)
    with pytest.raises(BrokenPipeError):
        PatientWriter(end, True).write(b"x")
    os.close(end)
    assert not PatientWriter.lost


@pytest.mark.parametrize("closed", [(0,), (1,), (0, 1), (0, 1, 2)])
def test_what_was_closed_before_the_start_is_no_number_for_another_file(tmp_path, closed):
    """A child would be given nowhere in the place of that file, or a library write its complaints into it."""
    program = (
        "import os, sys\nfrom hiernav.runtime.patient import be_patient\nbe_patient()\n"
        "open(sys.argv[1], 'w').write(str(min(os.pipe())))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path / "x")], preexec_fn=lambda: [os.close(each) for each in closed]
    )
    assert done.returncode == 0 and int((tmp_path / "x").read_text()) > 2


def test_what_a_terminal_of_few_characters_cannot_show_ends_nothing():
    program = "from hiernav.runtime.patient import be_patient\nbe_patient()\nprint('caf\\xe9')"
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True)
    assert done.stdout == b"caf\\xe9\n"
