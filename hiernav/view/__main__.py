"""Process of the live page; started by `ViewerLink`, ends when the control loop's end of the socket is closed."""

from __future__ import annotations

import os
import re
import select
import socket
import sys
import threading
from functools import partial
from typing import NoReturn

import msgspec
import websockets.asyncio.server

from hiernav.runtime import messages
from hiernav.runtime.observe import TickRecord
from hiernav.view.commands import MAX_BYTES, Asker, Command, Settings

OWN_ORIGIN = re.compile(r"http://(127\.0\.0\.1|localhost):\d+")


def main(descriptor: int) -> None:
    """Serve the page until the loop goes away."""
    _refuse_other_sites()
    from hiernav.view.page import Page

    with socket.socket(fileno=descriptor) as link:
        settings = msgspec.json.decode(link.recv(MAX_BYTES), type=Settings)
        ask = Asker(link)
        # viser serves in a thread of its own, and waits for ever for one that has failed
        threading.excepthook = lambda failed: _fail(ask, failed.exc_value)
        try:
            page = Page(settings, ask)
        except Exception as error:
            _fail(ask, error)
        threading.excepthook = threading.__excepthook__
        ask(Command("ready", text=page.url))
        decoder = messages.TickDecoder()
        while select.select([link], [], [])[0]:
            newest = None
            # everything that has come, so that a slow page shows the present and not the past
            while select.select([link], [], [], 0.0)[0]:
                data = link.recv(MAX_BYTES)
                if not data:
                    page.stop()
                    return
                topic, _, body = data.partition(b"\n")
                try:
                    item = decoder.add(messages.decode(topic.decode(), body))
                except messages.MessageError:
                    continue  # the tick refers to something that was left out
                if isinstance(item, TickRecord):
                    newest = item
                elif item is not None:
                    page.tell(item)
            if newest is not None:
                page.show(newest)


def _fail(ask: Asker, error: BaseException | None) -> NoReturn:
    """Tell the loop in one line why there is no page, and end, whatever threads there are."""
    ask(Command("failed", text=f"{type(error).__name__}: {' '.join(str(error).split())}"[:200]))
    os._exit(1)


def _refuse_other_sites() -> None:
    """Let no web page from elsewhere, open in the same browser, talk to this server."""
    server = websockets.asyncio.server
    setattr(server, "serve", partial(server.serve, origins=[OWN_ORIGIN, None]))  # noqa: B010  # it is typed as a class


if __name__ == "__main__":
    main(int(sys.argv[1]))
