"""Claims about commanding a running loop: goals are set, changed and cancelled, and nonsense is answered with why."""

from __future__ import annotations

import errno
import json
import os
import resource
import socket
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from puck import Puck, driver_of

from hiernav.runtime import control
from hiernav.runtime.clock import MonotonicClock
from hiernav.runtime.control import CLIENTS, ControlServer, obey, tell
from hiernav.runtime.driver import Driver
from hiernav.runtime.requests import LIMIT
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[tuple[Driver, Path]]:
    driver = driver_of(Puck(control_period=0.02, noise=1e-3), clock=MonotonicClock())
    path = tmp_path / "control.sock"
    thread = threading.Thread(target=driver.serve)
    with ControlServer(driver, path):
        thread.start()
        yield driver, path
        driver.quit()
        thread.join(30.0)
    assert not thread.is_alive() and not path.exists()


def until(path: Path, patience: float = 30.0, **wanted: object) -> dict[str, object]:
    end = time.monotonic() + patience
    while True:
        status = tell(path, "status")
        if all(status[key] == value for key, value in wanted.items()):
            return status
        assert time.monotonic() < end, status
        time.sleep(0.02)


def test_a_goal_is_set_changed_paused_and_cancelled(serving):
    _, path = serving
    until(path, mode="ready")
    assert "error" not in tell(path, "goal 1.9,0")
    until(path, mode="running", goal=[1.9, 0.0])
    tell(path, "goal -1.9,-0.5")
    until(path, mode="running", goal=[-1.9, -0.5])
    tell(path, "pause")
    until(path, mode="hold")
    tell(path, "resume")
    until(path, mode="running")
    tell(path, "cancel")
    status = until(path, mode="ready", goal=None)
    until(
        path, last={"reason": "cancelled", "detail": "", "steps": status["last"]["steps"]} if status["last"] else None
    )


def test_a_stop_latches_until_it_is_acknowledged_and_leads_to_ready_not_to_running(serving):
    _, path = serving
    until(path, mode="ready")
    tell(path, "goal 1.9,0")
    until(path, mode="running")
    tell(path, "stop")
    until(path, mode="estop", fault="stop was commanded", goal=None)
    answer = tell(path, "goal 1.0,0")
    assert answer["refused"] == "estop" and "before estop is acknowledged: stop was commanded" in answer["error"]
    assert tell(path, "status")["mode"] == "estop"
    tell(path, "acknowledge")
    until(path, mode="ready", fault=None, goal=None)


def test_a_command_is_answered_once_it_has_taken_effect(serving):
    _, path = serving
    until(path, mode="ready")
    assert tell(path, "goal 1.9,0")["goal"] == [1.9, 0.0]
    assert tell(path, "pause")["mode"] in ("armed", "hold")
    assert tell(path, "cancel")["goal"] is None
    assert tell(path, "stop")["mode"] == "estop"
    assert tell(path, "acknowledge")["mode"] == "ready"


def test_a_goal_that_is_refused_is_answered_with_why(serving):
    _, path = serving
    until(path, mode="ready")
    answer = tell(path, "goal 50,50")
    assert answer["refused"] == answer["last"]["reason"] == "goal_outside" and "50" in answer["error"]
    tell(path, "goal 1.9,0")
    tell(path, "cancel")
    answer = tell(path, "goal -1.9,0")
    assert "refused" not in answer, "that was the goal before it"
    assert answer["goal"] == [-1.9, 0.0] and answer["last"]["reason"] == "cancelled"


def answers_to(*commands: str) -> list[dict[str, object]]:
    """What those are answered who give these commands within one tick of a loop that is ready."""
    replies: list[Callable[[], dict[str, object] | None]] = []
    early: list[dict[str, object] | None] = []
    answers: list[dict[str, object]] = []
    modes: list[Mode] = []

    class Commanded(Puck):
        def read(self) -> SensorFrame:
            tick = self.log.count("read")
            if tick == 20:
                modes.append(driver.supervisor.mode)
                replies.extend(obey(driver, command) for command in commands)
                early.extend(reply() for reply in replies)
            if tick == 21:
                driver.quit()
                answers.extend(reply() or {} for reply in replies)
            return super().read()

    driver = driver_of(Commanded(noise=1e-3))
    driver.serve()
    assert modes == [Mode.READY] and len(answers) == len(commands)
    assert all(answer is None or answer["taken"] is False for answer in early), "nothing has taken effect"
    return answers


def test_whoever_sets_a_goal_is_told_of_that_goal():
    bad, good = answers_to("goal 50,50", "goal 1.9,0")
    assert (bad["refused"], bad["error"]) == ("changed", "changed") and "refused" not in good
    good, bad = answers_to("goal 1.9,0", "goal 50,50")
    assert good["refused"] == "changed" and bad["refused"] == "goal_outside" and "(50, 50)" in str(bad["error"])


def test_a_goal_that_a_stop_overtakes_is_refused():
    goal, stop = answers_to("goal 1.9,0", "stop")
    assert (goal["refused"], goal["error"], stop["mode"]) == ("estop", "stop was commanded", "estop")
    assert "error" not in stop


def test_commands_that_are_too_many_for_a_tick_are_told_so():
    first, *others = answers_to("pause", *["goal 1.9,0"] * LIMIT)
    assert first["taken"] is False and "16 commands" in str(first["error"])
    assert all("taken" not in other for other in others)


def test_a_flood_of_commands_from_other_threads_is_no_fault():
    """What is dropped for a newer command, the loop may have been about to take."""

    class Flooded(deque):
        def __len__(self) -> int:
            return super().__len__() + 1

    class Commanded(Puck):
        def read(self) -> SensorFrame:
            driver._requests._waiting = Flooded()
            if self.log.count("read") == 20:
                driver.quit()
            return super().read()

    driver = driver_of(Commanded(noise=1e-3))
    driver.serve()
    assert driver.supervisor.fault is None


def test_a_loop_that_does_not_tick_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(control, "PATIENCE", 0.2)
    driver = driver_of(Puck(control_period=0.02))
    with ControlServer(driver, tmp_path / "control.sock"):
        for command in ("goal 1.9,0", "stop"):
            answer = tell(tmp_path / "control.sock", command)
            assert answer["taken"] is False and "the loop stands" in answer["error"]
        assert "error" not in tell(tmp_path / "control.sock", "status")


@pytest.mark.parametrize("command", ["goal", "goal a,b", "goal nan,0", "goal 1,2,3", "dance", "cancel now", "", "  "])
def test_nonsense_is_answered_with_why_and_changes_nothing(serving, command):
    driver, path = serving
    assert "error" in tell(path, command)
    assert driver.goal is None


words = st.sampled_from([word for known in control.COMMANDS for word in known.split()])
pieces = words | st.sampled_from([" ", ",", "-", "1e999", "nan", "1_0", "\x00", "\n", "\r", "[/]", "\u0661", "\u2028"])
points = st.builds("goal {},{}".format, st.floats(), st.floats())
lines = st.one_of(
    st.binary(max_size=300),
    st.text(max_size=40).map(lambda text: text.encode() + b"\n"),
    st.lists(pieces, max_size=8).map(lambda parts: "".join(parts).encode() + b"\n"),
    (words | points).map(lambda text: text.encode() + b"\n"),
)


@given(said=lines, cut=st.integers(0, 300))
def test_whatever_a_client_says_is_answered_in_a_line_of_json_and_the_loop_ticks_on(said, cut):
    modes: list[Mode] = []

    class Commanded(Puck):
        def read(self) -> SensorFrame:
            tick = self.log.count("read")
            if tick == 20:
                for part in filter(None, (said[:cut], said[cut:])):
                    theirs.sendall(part)
                    if client.hear(driver):
                        break
                else:
                    theirs.shutdown(socket.SHUT_WR)
                    client.hear(driver)
            if tick == 22:
                driver.quit()
            modes.append(driver.supervisor.mode)
            return super().read()

    driver = driver_of(Commanded(noise=1e-3))
    ours, theirs = socket.socketpair()
    with ours, theirs:
        client = control._Client(ours)
        driver.serve()
        assert client.answered()
        answer = theirs.recv(65536)
    assert set(json.loads(answer)) & {"mode", "error"} and answer.endswith(b"\n") and answer.count(b"\n") == 1
    assert modes[20] is Mode.READY and Mode.FAULT not in modes
    assert len(modes) >= 23 or client.line.decode().strip() == "quit"


def test_a_client_that_floods_or_stalls_is_dropped(serving):
    _, path = serving
    for data in (b"x" * 100_000, b"\xff\xfe\n", b""):
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(path))
            try:
                client.sendall(data)
                client.shutdown(socket.SHUT_WR)
                client.recv(4096)
            except OSError:
                pass
    assert "error" not in tell(path, "status")


def connected(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(60.0)
    client.connect(str(path))
    return client


def test_a_stop_does_not_wait_for_clients_that_are_slow(serving, monkeypatch):
    """They have all the time they want, and are still at their lines when the stop has been obeyed."""
    _, path = serving
    monkeypatch.setattr(control, "PATIENCE", 20.0)
    slow = [connected(path) for _ in range(6)]
    for client in slow:
        client.sendall(b"sta")
    tell(path, "stop")
    until(path, mode="estop", fault="stop was commanded")
    for client in slow:
        with client:
            client.sendall(b"tus\n")
            assert b'"mode": "estop"' in client.recv(4096)


def test_a_client_has_so_much_time_for_its_line_and_not_for_each_byte_of_it(serving, monkeypatch):
    _, path = serving
    monkeypatch.setattr(control, "PATIENCE", 0.3)
    with connected(path) as client, pytest.raises(OSError):
        for _ in range(control.LONGEST - 1):
            client.sendall(b"x")
            time.sleep(0.02)


def test_of_too_many_clients_the_oldest_is_dropped_for_the_newest(serving, monkeypatch):
    _, path = serving
    monkeypatch.setattr(control, "PATIENCE", 60.0)
    idle = [connected(path) for _ in range(control.CLIENTS)]
    assert "error" not in tell(path, "stop")
    assert b"too many clients" in idle[0].recv(4096)
    for client in idle:
        client.close()


def test_a_loop_that_is_too_busy_to_be_connected_to_keeps_its_socket(tmp_path):
    path, waiting = tmp_path / "busy.sock", []
    with socket.socket(socket.AF_UNIX) as busy:
        busy.bind(str(path))
        busy.listen(0)
        with pytest.raises(BlockingIOError):
            for _ in range(100):
                waiting.append(socket.socket(socket.AF_UNIX))
                waiting[-1].setblocking(False)
                waiting[-1].connect(str(path))
        with pytest.raises(ValueError, match="another program listens there"):
            ControlServer(driver_of(), path)
        assert [file.name for file in tmp_path.iterdir()] == ["busy.sock"]
    for client in waiting:
        client.close()
    with ControlServer(driver_of(), path):  # nobody is left
        assert "error" not in tell(path, "status")


def test_only_this_user_may_connect_and_two_loops_do_not_share_a_socket(serving):
    driver, path = serving
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(ValueError, match="another loop listens there"):
        ControlServer(driver, path)


def test_a_path_that_no_socket_can_have_is_refused_with_the_limit(tmp_path):
    path = tmp_path / ("s" * (107 - len(os.fsencode(tmp_path)) - 1))
    with ControlServer(driver_of(), path):
        pass
    longer = path.with_name(path.name + "s")
    for what in (lambda: ControlServer(driver_of(), longer), lambda: tell(longer, "status")):
        with pytest.raises(ValueError, match="a path of 108 bytes, expected at most 107"):
            what()


def test_a_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(control.os, "getuid", lambda: tmp_path.stat().st_uid + 1)
    with pytest.raises(ValueError, match="the folder belongs to another user"):
        ControlServer(driver_of(), tmp_path / "loop.sock")
    assert not list(tmp_path.iterdir())


def test_a_socket_that_somebody_removed_is_still_taken(tmp_path):
    path = tmp_path / "loop.sock"
    with ControlServer(driver_of(), path):
        path.unlink()
        with pytest.raises(ValueError, match="another loop listens there"):
            ControlServer(driver_of(), path)
    assert not list(tmp_path.iterdir())


def test_what_a_dead_loop_left_is_replaced_and_nothing_is_left_at_the_end(tmp_path):
    path = tmp_path / "loop.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    path.with_name("loop.sock.lock").touch()
    with ControlServer(driver_of(), path):
        assert "error" not in tell(path, "status")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("target", ["absent", "file"])
def test_a_link_or_a_file_in_the_place_of_the_socket_is_left_alone(tmp_path, target):
    path = tmp_path / "loop.sock"
    path.symlink_to(tmp_path / "absent") if target == "absent" else path.touch()
    with pytest.raises(ValueError, match="there is something else"):
        ControlServer(driver_of(), path)
    assert [file.name for file in tmp_path.iterdir()] == ["loop.sock"]


def test_where_nothing_listens_that_is_said(tmp_path):
    with pytest.raises(ValueError, match="no loop answers"):
        tell(tmp_path / "absent.sock", "status")
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="there is something else"):
        ControlServer(driver_of(), tmp_path / "file")


def test_a_loop_is_found_where_no_temporary_file_can_be_made(monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "_get_default_tempdir", lambda *_: "/somewhere/else")
    monkeypatch.setattr(tempfile, "tempdir", None)
    assert control.default_socket() == tmp_path / f"hiernav-{os.getuid()}" / "hiernav-control.sock"


def test_a_goal_must_be_finite():
    with pytest.raises(ValueError, match="finite"):
        driver_of().set_goal(np.array([np.nan, 0.0]))


def test_what_goes_wrong_for_one_client_keeps_nobody_from_stopping_the_robot(tmp_path, monkeypatch):
    """Were the thread gone, the robot would drive on, and no command would reach it any more."""
    path, failures = tmp_path / "loop.sock", [MemoryError()]
    describe = control.describe

    def failing(driver: Driver) -> dict[str, object]:
        if failures:
            raise failures.pop()
        return describe(driver)

    monkeypatch.setattr(control, "describe", failing)
    with ControlServer(driver_of(), path):
        with pytest.raises(ValueError, match="no loop answers"):
            tell(path, "status")
        assert "error" not in tell(path, "status")


def test_a_process_without_room_for_clients_is_told_before_it_listens(tmp_path):
    """It could be driven otherwise, and nobody could connect to stop it."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    taken, limit, driver = set(map(int, os.listdir("/proc/self/fd"))), 0, driver_of()
    while limit - sum(number < limit for number in taken) < CLIENTS:
        limit += 1
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        with pytest.raises(ValueError, match=f"for {2 * CLIENTS} clients, RLIMIT_NOFILE is {limit}"):
            ControlServer(driver, tmp_path / "loop.sock")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert not list(tmp_path.iterdir())


def test_a_robot_is_stopped_by_a_process_that_may_have_no_more_files(serving, caplog, monkeypatch):
    """Of one that has used up its files while it drives, as with a limit that was lowered meanwhile."""
    _, path = serving
    monkeypatch.setattr(control, "HASTE", 0.5)  # a busy machine may keep this test from saying its line for a while
    until(path, mode="ready")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    lines = [b""] * 5 + [b"stop\n", b"status\n"]  # the first have nothing to say, and are not waited for long
    clients = [socket.socket(socket.AF_UNIX) for _ in lines]
    limit = os.dup(0)  # the lowest that is free
    os.close(limit)
    answers: list[dict[str, object]] = []
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        for client, line in zip(clients, lines, strict=True):
            client.settimeout(20.0)
            client.connect(str(path))
            client.sendall(line)
        for client in clients:
            answers.append(json.loads(client.recv(4096)))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
        for client in clients:
            client.close()
    assert all("error" in answer for answer in answers[:5])
    assert [answer["mode"] for answer in answers[5:]] == ["estop", "estop"]
    assert len(caplog.messages) == 1 and "at most one client at a time" in caplog.messages[0]
    assert "error" not in tell(path, "status")


def test_a_process_with_a_thousand_files_open_is_commanded(tmp_path):
    """Descriptors that `select` has no room for."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before[1] != resource.RLIM_INFINITY and before[1] < 1200:
        pytest.skip("this system allows no process as many files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (1200, before[1]))
    files: list[int] = []
    try:
        with ControlServer(driver_of(), tmp_path / "loop.sock"):
            while not files or files[-1] < 1100:
                files.append(os.open(os.devnull, os.O_RDONLY))
            assert "error" not in tell(tmp_path / "loop.sock", "status")
    finally:
        for file in files:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.parametrize(("reminder", "times"), [(60.0, 1), (-1.0, 2)])
def test_that_nobody_can_connect_any_more_is_told_once_in_a_while(tmp_path, monkeypatch, caplog, reminder, times):
    monkeypatch.setattr(control, "REMINDER", reminder)
    path, tries = tmp_path / "loop.sock", []

    class Full(socket.socket):
        def accept(self):
            tries.append(0)
            if len(tries) < 4:
                raise OSError(errno.EMFILE, "Too many open files")
            return super().accept()

    monkeypatch.setattr(control.socket, "socket", Full)
    with ControlServer(driver_of(), path):
        assert "error" not in tell(path, "status")
    assert [each for each in caplog.messages if "Too many open files: at most one client" in each] == caplog.messages
    assert len(caplog.messages) == times


def test_a_system_without_room_for_a_thread_leaves_nothing_at_the_path(tmp_path, monkeypatch):
    def no_room(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_room)
    with pytest.raises(RuntimeError, match="start new thread"), ControlServer(driver_of(), tmp_path / "loop.sock"):
        pass
    assert not list(tmp_path.iterdir())
