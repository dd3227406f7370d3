"""Goals and commands for a running loop over a Unix socket: one line of text in, one line of JSON out."""

from __future__ import annotations

import json
import logging
import math
import os
import socket
import stat
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np

from hiernav.runtime.driver import Driver

LONGEST = 256
"""Bytes of a command."""
PATIENCE = 1.0
"""Time a client may take for its line [s]."""
COMMANDS = ("goal X,Y", "cancel", "pause", "resume", "stop", "acknowledge", "status", "quit")

log = logging.getLogger(__name__)


def default_socket() -> Path:
    """Where a loop of this user listens: a folder that nobody else can enter."""
    run = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(run) if run else Path(tempfile.gettempdir()) / f"hiernav-{os.getuid()}"
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


def obey(driver: Driver, command: str) -> dict[str, Any]:
    """Do what a line says.

    Raises:
        ValueError: it says nothing that is known.
    """
    word, _, rest = command.strip().partition(" ")
    if word == "goal":
        driver.set_goal(parse_point(rest.strip()))
    elif rest or word not in (known.split()[0] for known in COMMANDS):
        raise ValueError(f"unknown command {command.strip()!r}; known: {', '.join(COMMANDS)}")
    elif word == "stop":
        driver.estop("stop was commanded")
    elif word != "status":
        getattr(driver, word)()
    return describe(driver)


def describe(driver: Driver) -> dict[str, Any]:
    """The state of a loop, in JSON's own types."""
    estimate, result, goal = driver.estimate, driver.last_result, driver.goal
    return {
        "mode": driver.supervisor.mode.value,
        "why": driver.supervisor.why,
        "fault": driver.supervisor.fault,
        "goal": None if goal is None else goal.tolist(),
        "pose": None if estimate is None else estimate.pose.tolist(),
        "speed": None if estimate is None else math.hypot(*estimate.velocity.tolist()),
        "last": None if result is None else {"reason": result.reason, "detail": result.detail, "steps": result.steps},
        "rate": driver.timer.rate,
        "ticks": driver.loop.ticks,
        "overruns": driver.loop.overruns,
    }


class ControlServer:
    """Listens in a thread of its own, for as long as it is entered (`with`)."""

    def __init__(self, driver: Driver, path: Path) -> None:
        """
        Args:
            driver: that is commanded.
            path: of the socket; only this user may connect. What a dead loop left there is replaced.

        Raises:
            ValueError: the folder belongs to somebody else, or a loop that lives listens there.
        """
        self.driver, self.path = driver, path
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.parent.stat().st_uid != os.getuid():
            raise ValueError(f"control socket {path}: the folder belongs to another user")
        if path.exists():
            if not stat.S_ISSOCK(path.stat().st_mode):
                raise ValueError(f"control socket {path}: there is something else")
            if _answers(path):
                raise ValueError(f"control socket {path}: another loop listens there")
            path.unlink()
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(0o177)
        try:
            self._server.bind(str(path))
        except OSError as error:
            raise ValueError(f"control socket {path}: {error}") from None
        finally:
            os.umask(before)
        self._server.listen(4)
        self._thread = threading.Thread(target=self._listen, name="control", daemon=True)

    def __enter__(self) -> ControlServer:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.path.unlink(missing_ok=True)
        self._thread.join(2.0)

    def _listen(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            with client:
                client.settimeout(PATIENCE)
                try:
                    client.sendall(json.dumps(self._reply(client)).encode() + b"\n")
                except OSError as error:
                    log.warning("control client: %s", error)

    def _reply(self, client: socket.socket) -> dict[str, Any]:
        line = b""
        while not line.endswith(b"\n"):
            part = client.recv(LONGEST)
            line += part
            if not part or len(line) > LONGEST:
                return {"error": f"expected one line of at most {LONGEST} bytes"}
        try:
            return obey(self.driver, line.decode())
        except ValueError as error:  # undecodable text among them
            return {"error": str(error)}


def tell(path: Path, command: str) -> dict[str, Any]:
    """Send a command to the loop that listens at `path`; its answer.

    Raises:
        ValueError: nothing listens there.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(2.0 * PATIENCE)
            client.connect(str(path))
            client.sendall(command.strip().encode() + b"\n")
            with client.makefile("rb") as answer:
                return json.loads(answer.readline())
    except (OSError, json.JSONDecodeError) as error:
        raise ValueError(f"no loop answers at {path}: {error}") from None


def _answers(path: Path) -> bool:
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
            client.settimeout(PATIENCE)
            client.connect(str(path))
        return True
    except OSError:
        return False
