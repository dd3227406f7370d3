"""Goals and commands for a running loop over a Unix socket: one line of text in, one line of JSON out."""

from __future__ import annotations

import errno
import fcntl
import json
import logging
import math
import os
import resource
import select
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.runtime.driver import Driver
from hiernav.runtime.ticket import Ticket

LONGEST = 256
"""Bytes of a command."""
PATIENCE = 1.0
"""Time a client may take for its line, all of it, and at most that of an answer from then on [s]."""
HASTE = 0.05
"""The same where others wait and there is no room for them [s]."""
REMINDER = 60.0
"""Time until the same complaint is made again [s]."""
LOOK_AGAIN = 0.005
"""Time between looks at whether a command has taken effect [s]."""
CLIENTS = 32
"""Clients that may be at their line at the same time; the one after them takes the place of the first."""
COMMANDS = ("goal X,Y", "cancel", "pause", "resume", "stop", "acknowledge", "status", "quit")

NO_ROOM = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
"""What `accept` says where it is not the client's fault."""

LONGEST_PATH = 107
"""Of a socket [bytes]; the system's."""

log = logging.getLogger(__name__)


def default_socket() -> Path:
    """Where a loop of this user listens: a folder that nobody else can enter."""
    run = os.environ.get("XDG_RUNTIME_DIR")
    # not `tempfile.gettempdir()`, which is another folder, or an error, where the disk is full
    folder = Path(run) if run else Path(os.environ.get("TMPDIR") or "/tmp") / f"hiernav-{os.getuid()}"
    return folder / "hiernav-control.sock"


def parse_point(text: str) -> np.ndarray:
    """X,Y -> (2,) [m].

    Raises:
        ValueError: not two finite numbers.
    """
    try:
        point = np.array([float(part) for part in text.split(",")])
    except ValueError:
        point = np.empty(0)
    if point.shape != (2,) or not np.isfinite(point).all():
        raise ValueError(f"{text!r}: expected X,Y in metres, for example 1.2,-0.5")
    return point


def obey(driver: Driver, command: str) -> Callable[[], dict[str, Any] | None]:
    """Do what a line says.

    Returns:
        What tells the state that this has led to, and None before it has taken effect: a loop takes its commands at the
        beginning of a tick. The answer has an `error` where a goal is not driven to (`refused`: why, in one word), and
        where the command was not `taken`.

    Raises:
        ValueError: it says nothing that is known.
    """
    word, _, rest = command.strip().partition(" ")
    ticket: Ticket | None = None
    if word == "goal":
        ticket = driver.set_goal(parse_point(rest.strip()))
    elif rest or word not in (known.split()[0] for known in COMMANDS):
        raise ValueError(f"unknown command {command.strip()!r}; known: {', '.join(COMMANDS)}")
    elif word == "stop":
        ticket = driver.estop("stop was commanded")
    elif word != "status":
        ticket = getattr(driver, word)()
    late = time.monotonic() + PATIENCE

    def answer() -> dict[str, Any] | None:
        if ticket is None:
            return describe(driver)
        if ticket.dropped:
            return {**describe(driver), "taken": False, "error": ticket.why}
        if not ticket.settled(driver.loop.ticks):
            if time.monotonic() < late:
                return None
            if ticket.taken is None:
                why = f"not taken within {PATIENCE:g} s: the loop stands"
                return {**describe(driver), "taken": False, "error": why}
        if ticket.refused is not None:
            return {**describe(driver), "refused": ticket.refused, "error": ticket.why or ticket.refused}
        return describe(driver)

    return answer


def describe(driver: Driver) -> dict[str, Any]:
    """The state of a loop, in JSON's own types."""
    estimate, ended, goal = driver.estimate, driver.last_trip, driver.goal
    return {
        "mode": driver.supervisor.mode.value,
        "why": driver.supervisor.why,
        "fault": driver.supervisor.fault,
        "paused": driver.paused,
        "goal": None if goal is None else goal.tolist(),
        "pose": None if estimate is None else estimate.pose.tolist(),
        "speed": None if estimate is None else math.hypot(*estimate.velocity.tolist()),
        "last": None if ended is None else {"reason": ended.reason, "detail": ended.detail, "steps": ended.steps},
        "rate": driver.timer.rate,
        "ticks": driver.loop.ticks,
        "overruns": driver.loop.overruns,
    }


class ControlServer:
    """Listens in a thread of its own, for as long as it is entered (`with`).

    A line is obeyed as soon as it is whole: no client waits for another one, however slow that is. It is answered once
    it has taken effect.
    """

    def __init__(self, driver: Driver, path: Path) -> None:
        """
        Args:
            driver: that is commanded.
            path: of the socket; only this user may connect. What a dead loop left there is replaced.

        Raises:
            ValueError: the path is too long for a socket, the folder belongs to somebody else, or a loop that lives
                listens there.
        """
        self.driver, self.path = driver, path
        _require_short(path)
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.parent.stat().st_uid != os.getuid():
            raise ValueError(f"control socket {path}: the folder belongs to another user")
        self._lock = _Lock(path)
        try:
            _require_room(path)
            self._server = self._listening()
        except BaseException:
            self._lock.release()
            raise
        self._closed = False
        self._told = "", 0.0
        self._reserve: int | None = None
        self._take_reserve()
        self._thread = threading.Thread(target=self._listen, name="control", daemon=True)

    def __enter__(self) -> ControlServer:
        try:
            self._thread.start()
        except RuntimeError:  # the system has no room for another thread
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Listen no longer, or never, and leave nothing at the path."""
        self._closed = True
        self._server.shutdown(socket.SHUT_RDWR)  # wakes the thread
        if self._thread.ident is not None:
            self._thread.join(2.0)
        self._server.close()
        self._give_up_reserve()
        self.path.unlink(missing_ok=True)
        self._lock.release()

    def _listening(self) -> socket.socket:
        """The socket, in the place of what a dead loop left."""
        path = self.path
        if path.is_symlink() or path.exists():
            if not stat.S_ISSOCK(path.lstat().st_mode):
                raise ValueError(f"control socket {path}: there is something else")
            if _answers(path):
                raise ValueError(f"control socket {path}: another program listens there")
            path.unlink(missing_ok=True)
        server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            server.bind(str(path))
        except OSError as error:
            server.close()
            raise ValueError(f"control socket {path}: {error}") from None
        finally:
            os.umask(before)
        server.listen(CLIENTS)
        server.setblocking(False)
        return server

    def _listen(self) -> None:
        """The thread. It goes on whatever happens, such as no memory: else nobody could stop the robot any more."""
        clients: list[_Client] = []  # the first to have come is the first to run out of time
        obeyed: list[_Client] = []
        while not self._closed:
            try:
                self._answer_clients(clients, obeyed)
            except Exception as error:
                self._complain(f"{type(error).__name__}: {error}; all clients are dropped")
                for client in (*clients, *obeyed):
                    client.socket.close()
                clients.clear()
                obeyed.clear()
                time.sleep(0.01)
        for client in clients:
            client.socket.close()

    def _complain(self, why: str) -> None:
        """Tell what keeps commands away, once in a while as long as that does."""
        told, since = self._told
        if why != told or time.monotonic() - since > REMINDER:
            log.error("control socket %s: %s", self.path, why)
            self._told = why, time.monotonic()

    def _answer_clients(self, clients: list[_Client], obeyed: list[_Client]) -> None:
        """Listen until the end, with who is at a line in `clients`, and who waits for an answer in `obeyed`."""
        while not self._closed:
            wait = max(clients[0].deadline - time.monotonic(), 0.0) if clients else None
            if obeyed:
                wait = LOOK_AGAIN if wait is None else min(wait, LOOK_AGAIN)
            ready = _ready((self._server, *clients), wait)
            for client in [each for each in clients if each.fileno() in ready and each.hear(self.driver)]:
                clients.remove(client)
                obeyed.append(client)
            obeyed[:] = [client for client in obeyed if not client.answered()]
            while len(obeyed) > CLIENTS:
                obeyed.pop(0).answer({"taken": None, "error": "too many clients wait for their answers"})
            while clients and clients[0].deadline <= time.monotonic():
                clients.pop(0).answer({"error": f"expected one line within {PATIENCE:g} s"})
            self._take_reserve()
            if self._server.fileno() in ready:
                try:
                    clients.append(_Client(self._accept()))
                except OSError as error:  # the client is gone again, there is no room for one, or this is the end
                    if error.errno in NO_ROOM and clients and clients[0].hesitates():
                        clients.pop(0).answer({"error": "silent where others wait, and there is room for one"})
                    time.sleep(0.01)
                    continue
                if len(clients) > CLIENTS:
                    clients.pop(0).answer({"error": "too many clients"})
        for client in obeyed:
            if not client.answered():
                client.answer({"taken": False, "error": "the loop has ended"})

    def _accept(self) -> socket.socket:
        """The next client, in the place of the reserve where this process may have no more files.

        Raises:
            OSError: there is none, or no room for it.
        """
        try:
            return self._server.accept()[0]
        except OSError as error:
            if error.errno not in NO_ROOM:
                raise
            self._complain(f"{error.strerror}: at most one client at a time can give a command")
            if self._reserve is None:
                raise
            self._give_up_reserve()
            return self._server.accept()[0]

    def _take_reserve(self) -> None:
        """Hold a descriptor that the next client can have where there is no other: it may be the one who says stop."""
        if self._reserve is None:
            with suppress(OSError):
                self._reserve = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _give_up_reserve(self) -> None:
        reserve, self._reserve = self._reserve, None
        if reserve is not None:
            os.close(reserve)


class _Client:
    """Somebody who is at a line."""

    def __init__(self, connected: socket.socket) -> None:
        self.socket, self.line = connected, b""
        self._reply: Callable[[], dict[str, Any] | None] = lambda: None
        self.deadline = time.monotonic() + PATIENCE
        connected.setblocking(False)

    def fileno(self) -> int:
        return self.socket.fileno()

    def hesitates(self) -> bool:
        """Whether its line is not there yet though others wait."""
        return self.deadline - time.monotonic() < PATIENCE - HASTE

    def hear(self, driver: Driver) -> bool:
        """Take what has come, and do what it says once it is a line; False if more is to come."""
        refusal: dict[str, Any] | None = None
        try:
            part = self.socket.recv(LONGEST)
            self.line += part
            if not part or len(self.line) > LONGEST:
                refusal = {"error": f"expected one line of at most {LONGEST} bytes"}
            elif not self.line.endswith(b"\n"):
                return False
            else:
                self._reply = obey(driver, self.line.decode())
        except (OSError, ValueError) as error:  # undecodable text among the latter
            refusal = {"error": str(error)}
        if refusal is not None:
            self._reply = lambda: refusal
        return True

    def answered(self) -> bool:
        """Answer, once there is something to say."""
        reply = self._reply()
        if reply is None:
            return False
        self.answer(reply)
        return True

    def answer(self, reply: dict[str, Any]) -> None:
        """Say it, which fits into the socket, and hang up."""
        with self.socket:
            try:
                self.socket.sendall(json.dumps(reply).encode() + b"\n")
            except OSError as error:
                log.warning("control client: %s", error)


def _ready(heard: Iterable[socket.socket | _Client], wait: float | None) -> set[int]:
    """The descriptors at which there is something to read, after at most `wait` [s]; their numbers may be large."""
    poll = select.poll()
    for each in heard:
        poll.register(each, select.POLLIN)
    return {descriptor for descriptor, _ in poll.poll(None if wait is None else math.ceil(1e3 * wait))}


def tell(path: Path, command: str) -> dict[str, Any]:
    """Send a command to the loop that listens at `path`; its answer.

    Raises:
        ValueError: nothing listens there, or no socket can have this path.
    """
    _require_short(path)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(2.0 * PATIENCE)
            _connect(client, path, 2.0 * PATIENCE)
            with suppress(BrokenPipeError):  # it has hung up, and said why
                client.sendall(command.strip().encode() + b"\n")
            with client.makefile("rb") as answer:
                return json.loads(answer.readline())
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"no loop answers at {path}: {error}") from None


def _require_short(path: Path) -> None:
    size = len(os.fsencode(path))
    if size > LONGEST_PATH:
        raise ValueError(f"control socket {path}: a path of {size} bytes, expected at most {LONGEST_PATH}")


def _require_room(path: Path) -> None:
    """ValueError unless this process may have as many clients as are served at the same time."""
    places: list[int] = []
    try:
        places += (os.open(os.devnull, os.O_RDONLY) for _ in range(2 * CLIENTS + 1))
    except OSError as error:
        limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
        why = f"{error.strerror} for {2 * CLIENTS} clients, RLIMIT_NOFILE is {limit}"
        raise ValueError(f"control socket {path}: {why}") from None
    finally:
        for place in places:
            os.close(place)


def _connect(client: socket.socket, path: Path, patience: float) -> None:
    """Connect, within `patience` [s]: a loop to which many connect at once may have no room for a moment."""
    end = time.monotonic() + patience
    while True:
        try:
            return client.connect(str(path))
        except BlockingIOError:
            if time.monotonic() > end:
                raise
            time.sleep(0.01)


def _answers(path: Path) -> bool:
    """Whether somebody who lives may listen there: who is busy does, and only who is gone refuses."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(PATIENCE)
            client.connect(str(path))
    except (ConnectionRefusedError, FileNotFoundError):
        return False
    except OSError:
        pass
    return True


class _Lock:
    """That one loop alone listens at a path: a lock on a file beside it, which ends with the process that has it."""

    def __init__(self, path: Path) -> None:
        """ValueError if another process has it."""
        self._path = path.with_name(path.name + ".lock")
        while True:
            try:
                self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
            except OSError as error:
                raise ValueError(f"control socket {path}: {error}") from None
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(self._file)
                why = "another loop listens there" if isinstance(error, BlockingIOError) else str(error)
                raise ValueError(f"control socket {path}: {why}") from None
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(self._file), self._path.stat()):
                    return
            os.close(self._file)  # whoever had it has removed it meanwhile

    def release(self) -> None:
        self._path.unlink(missing_ok=True)
        os.close(self._file)
