"""The loop's side of the live page, with programs in the place of the page that behave well, badly, or not at all."""

from __future__ import annotations

import itertools
import json
import socket
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from page_stub import Asked, link_to

from hiernav.nav.occupancy import OccupancyMap
from hiernav.runtime import messages
from hiernav.runtime.observe import Audience, Event, TickRecord
from hiernav.runtime.robot import SensorFrame
from hiernav.runtime.supervisor import Mode
from hiernav.view import link as link_module
from hiernav.view.commands import MAX_BYTES, Asker, Command
from hiernav.view.link import COMMANDS_PER_TICK, HEARD_PER_TICK, ViewerLink, coarser


def record(index: int, **changes) -> TickRecord:
    pixels = np.random.default_rng(index).random((80, 80)) > 0.5
    plain = TickRecord(
        index=index, time=0.1 * index, lateness=0.0, mode=Mode.RUNNING, frame=SensorFrame(0.1 * index),
        occupancy=OccupancyMap(pixels), plan=np.full((10, 2), float(index)), replanned=True,
    )  # fmt: skip
    return replace(plain, **changes)


def ticks_until(link: ViewerLink, done, limit: float = 30.0) -> int:
    """Tick until something holds; how often."""
    deadline, index = time.monotonic() + limit, 0
    while not done():
        assert time.monotonic() < deadline
        link.make_requests()
        link.tick(record(index))
        index += 1
        time.sleep(0.005)
    return index


def until(done, limit: float = 30.0) -> None:
    deadline = time.monotonic() + limit
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_page_is_shown_ticks_as_they_are_and_its_wishes_are_granted(tmp_path):
    out = tmp_path / "seen"
    control, injected = Asked(), []
    link = link_to(
        f"""
for kind in ("pause", "resume", "cancel", "acknowledge", "estop"): say(kind=kind)
with open({str(out)!r}, "ab", buffering=0) as file:
    while data := link.recv(1000000):
        if data.startswith(b"/event"):
            say(kind="goal", x=1.5, y=-2.0)
            say(kind="fault", text="flood")
        file.write(len(data).to_bytes(4, "little") + data)
""",
        control,
        faults={"flood": lambda: injected.append(1)},
    )
    assert link.url == "http://127.0.0.1:1"
    link.first_goal = np.array([0.5, 0.5])
    ticks_until(link, lambda: len(control.calls) == 6)
    link.event(Event(0.0, "stop", "the robot stands"))
    ticks_until(link, lambda: injected and link.shown > 5)
    link.close()
    assert control.calls == [
        ("goal", 0.5, 0.5), ("pause",), ("resume",), ("cancel",), ("acknowledge",), ("estop",), ("goal", 1.5, -2.0),
    ]  # fmt: skip
    decoder, data, read = messages.TickDecoder(), out.read_bytes(), []
    while data:
        size = int.from_bytes(data[:4], "little")
        topic, _, body = data[4 : 4 + size].partition(b"\n")
        read.append(decoder.add(messages.decode(topic.decode(), body)))
        data = data[4 + size :]
    read = [item for item in read if isinstance(item, TickRecord)]
    assert len(read) == link.shown
    for item in read:
        np.testing.assert_array_equal(item.occupancy.occupied, record(item.index).occupancy.occupied)
        np.testing.assert_array_equal(item.plan, record(item.index).plan)


def test_a_page_that_takes_nothing_any_more_misses_ticks_and_nobody_waits():
    link = link_to("time.sleep(1000)")
    for index in range(2000):
        link.tick(record(index))
    assert link.dropped > 1000 and link.shown > 0
    link._process.kill()
    link.close()


def test_of_a_page_that_floods_a_few_commands_a_tick_are_obeyed():
    control = Asked()
    link = link_to("time.sleep(1000)", control)
    ours, page = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    page.setblocking(False)
    link._socket.close()
    link._socket = ours
    asked = itertools.cycle(
        [
            b'{"kind":"goal","x":1.0,"y":0.0}',
            b"\xff{nonsense",
            b'{"kind":"self-destruct"}',
            b'{"kind":"fault","text":"unknown"}',
            b'{"kind":"goal","x":NaN,"y":0.0}',
        ]
    )
    for _ in range(200):
        with suppress(BlockingIOError):  # until it takes no more: at every tick there is more than can be heard
            while True:
                page.send(next(asked))
        calls, refused = len(control.calls), link.refused
        link.make_requests()
        assert len(control.calls) - calls <= COMMANDS_PER_TICK
        assert len(control.calls) - calls + link.refused - refused == HEARD_PER_TICK
    assert {call[0] for call in control.calls} == {"goal"} and len(control.calls) > 20
    assert link.refused > 80
    link._process.kill()
    link.close()
    page.close()


values = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.lists(st.integers())
kinds = st.sampled_from([*"ready failed goal cancel pause resume estop acknowledge fault".split(), "", "quit", 7])
asked = st.dictionaries(st.sampled_from(["x", "y", "text", "z"]), values | st.just("flood"), max_size=3)
said = st.one_of(
    st.binary(min_size=1, max_size=200),
    st.builds(lambda kind, rest: json.dumps({"kind": kind, **rest}).encode(), kinds, asked),
    st.builds(lambda kind, x: json.dumps({"kind": kind, "x": x}).encode(), kinds, st.floats() | st.just(10**400)),
    st.sampled_from([b"[" * 4000, b'{"kind":' + b"[" * 4000, b'{"z":' + b"[" * 4000, b'{"kind":"goal"' * 99]),
)


def test_whatever_the_page_says_is_done_or_refused_and_the_loop_ticks_on():
    control, injected = Asked(), []
    link = link_to("time.sleep(1000)", control, faults={"flood": lambda: injected.append(1)})
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    link._socket.close()
    link._socket = ours

    @example([b'{"kind":"fault","text":"flood"}', b'{"kind":"ready"}', b'{"kind":"estop"}'])
    @given(st.lists(said, min_size=1, max_size=2 * COMMANDS_PER_TICK))
    def says(messages: list[bytes]) -> None:
        before = len(control.calls) + len(injected) + link.refused
        for message in messages:
            theirs.send(message)
        link.make_requests()
        assert len(control.calls) + len(injected) + link.refused - before == len(messages)
        assert link._socket is ours

    with theirs:
        says()
        assert control.calls and injected and link.refused
    link._process.kill()
    link.close()


def test_an_emergency_stop_is_obeyed_in_the_tick_in_which_it_is_found_whatever_was_said_before_it(tmp_path):
    control, said = Asked(), tmp_path / "said"
    link = link_to(
        f"""
for k in range(100): say(kind="goal", x=float(k), y=0.0)
say(kind="estop")
open({str(said)!r}, "w").close()
time.sleep(1000)
""",
        control,
    )
    until(said.exists)
    link.make_requests()
    assert control.calls == [("goal", float(k), 0.0) for k in range(COMMANDS_PER_TICK)] + [("estop",)]
    assert link.refused == 100 - COMMANDS_PER_TICK
    link._process.kill()
    link.close()


def test_all_that_can_wait_on_the_socket_is_heard_in_one_tick(tmp_path):
    control, full = Asked(), tmp_path / "full"
    link = link_to(
        f"""
try:
    while True: link.send(b'{{"kind":"pause"}}', socket.MSG_DONTWAIT)
except BlockingIOError:
    open({str(full)!r}, "w").close()
time.sleep(1000)
""",
        control,
    )
    until(full.exists)
    link.make_requests()
    assert link.refused > 100
    assert link._receive() is None
    link._process.kill()
    link.close()


def test_an_emergency_stop_that_finds_the_socket_full_waits_for_it_and_what_is_asked_for_later_is_lost():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.settimeout(30.0)
        ask = Asker(theirs)
        for k in range(1000):
            ask(Command("goal", float(k)))
        stopping = threading.Thread(target=ask, args=(Command("estop"),))
        stopping.start()
        until(ask._stopping.locked)
        ours.recv(MAX_BYTES)  # there is room for one more
        ask(Command("cancel"))
        kinds = []
        while "estop" not in kinds:
            kinds.append(msgspec.json.decode(ours.recv(MAX_BYTES), type=Command).kind)
        assert set(kinds[:-1]) == {"goal"}
        stopping.join()
        ask(Command("cancel"))
        assert msgspec.json.decode(ours.recv(MAX_BYTES), type=Command).kind == "cancel"


def test_what_a_page_says_to_a_loop_that_is_gone_is_lost_without_waiting():
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.close()
    with theirs:
        ask = Asker(theirs)
        for kind in ("goal", "estop", "cancel"):
            ask(Command(kind))


def test_a_page_that_dies_is_forgotten():
    link = link_to("raise SystemExit")
    ticks_until(link, lambda: link._socket is None)
    link.tick(record(0))
    link.close()


def test_a_page_that_was_too_slow_is_shown_map_and_plan_again():
    """What it missed may have been a map or a plan that later ticks refer to."""
    link = link_to(
        """
time.sleep(1.0)
while data := link.recv(1000000): pass
"""
    )
    still = record(0).occupancy
    sent: list[str] = []
    send = link._send
    link._send = lambda topic, data: sent.append(topic) or send(topic, data)
    ticks = 0
    while link.dropped == 0:
        link.tick(record(ticks, occupancy=still))
        ticks += 1
    assert sent.count("/map") == 1
    sent.clear()
    ticks_until(link, lambda: link.shown and "/tick" in sent)
    assert "/map" in sent and "/plan" in sent
    link.close()


@pytest.mark.parametrize("program", ["raise SystemExit", "import os; os._exit(3)"])
def test_a_page_that_does_not_come_up_is_said_so_before_the_robot_moves(program):
    with pytest.raises(ValueError, match="does not come up"):
        ViewerLink(Asked(), 0.1, 0.3, program=(sys.executable, "-c", program))


def test_why_a_page_does_not_come_up_is_passed_on_at_once():
    """The port cannot be had: the page's server, which has a thread of its own, fails there."""
    pytest.importorskip("viser")
    with pytest.raises(ValueError, match="does not come up: OverflowError: .*0-65535"):
        ViewerLink(Asked(), 0.1, 0.3, port=70000)


def test_a_large_map_is_made_coarser_and_loses_no_obstacle():
    pixels = np.zeros((3000, 2000), dtype=bool)
    pixels[1234, 777] = pixels[-1, -1] = True
    large = OccupancyMap(pixels, 0.05, (-3.0, 4.0))
    coarse = coarser(large, 1_000_000)
    assert coarse.occupied.size < 1_100_000
    for row, column in np.argwhere(pixels):
        point = (-3.0 + 0.05 * (column + 0.5), 4.0 + 0.05 * (row + 0.5))
        assert coarse.occupied_at(point)
    link = link_to("time.sleep(1000)")
    link.tick(record(0, occupancy=large))
    deadline = time.monotonic() + 30.0
    while link._coarse is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert link._with_coarse_map(record(1), large).occupancy.occupied.size < 1_100_000
    link._process.kill()
    link.close()


def test_of_a_large_map_that_changes_the_newest_that_is_done_is_shown_and_one_thread_is_at_work(monkeypatch):
    done, begun = threading.Semaphore(0), []

    def slow(occupancy: OccupancyMap, most: int) -> OccupancyMap:
        begun.append(occupancy)
        assert done.acquire(timeout=30.0)
        return coarser(occupancy, most)

    monkeypatch.setattr(link_module, "coarser", slow)
    link = link_to("time.sleep(1000)")
    maps = []
    for k in range(6):
        pixels = np.zeros((1100, 1000), dtype=bool)
        pixels[100 * k] = True
        maps.append(OccupancyMap(pixels))

    def shown(k: int) -> OccupancyMap | None:
        return link._with_coarse_map(record(k), maps[k]).occupancy

    assert [shown(k) for k in range(3)] == [None] * 3
    done.release()
    until(lambda: link._coarse is not None and not link._coarsening)
    first = shown(3)
    assert first is shown(4) is shown(5) and first.occupied[0].all()
    until(lambda: begun == [maps[0], maps[3]])
    done.release()
    until(lambda: shown(3) is not first)
    assert shown(3).occupied[150].all() and begun == [maps[0], maps[3]]
    link._process.kill()
    link.close()


def test_a_page_that_cannot_be_shown_a_tick_still_stops_the_robot(monkeypatch):
    """For want of memory, say. A link that raised would be dropped from the audience, and its stop button with it."""
    asked = Asked()
    link = link_to('link.recv(1000000)\nsay(kind="estop")\nwhile link.recv(1000000): pass', asked)
    audience, failures = Audience([link]), [MemoryError()]
    encode = messages.TickEncoder.encode

    def failing(encoder: messages.TickEncoder, tick: TickRecord) -> object:
        if failures:
            raise failures.pop()
        return encode(encoder, tick)

    monkeypatch.setattr(messages.TickEncoder, "encode", failing)
    for index in range(2):
        audience.tell(lambda observer, index=index: observer.tick(record(index)))
    assert audience.observers == [link] and (link.dropped, link.shown) == (1, 1)
    for _ in range(6000):
        audience.tell(lambda observer: observer.make_requests())
        if asked.calls:
            break
        time.sleep(0.005)
    link.close()
    assert asked.calls == [("estop",)]


def test_a_large_map_is_shown_later_where_the_system_has_no_room_for_a_thread(monkeypatch):
    link = link_to("while link.recv(1000000): pass")
    large = OccupancyMap(np.zeros((1200, 1200), np.bool_))
    with monkeypatch.context() as patch:
        patch.setattr(
            threading.Thread, "start", lambda _: (_ for _ in ()).throw(RuntimeError("can't start new thread"))
        )
        link.tick(record(0, occupancy=large))
    assert (link.shown, link.dropped) == (1, 0)
    ticks, deadline = 1, time.monotonic() + 30.0
    while link._coarse is None:
        assert time.monotonic() < deadline
        link.tick(record(ticks, occupancy=large))
        ticks += 1
        time.sleep(0.005)
    link.close()
