"""Process of the live page; started by `ViewerLink`, ends when the control loop's end of the socket is closed."""

from __future__ import annotations

import http
import logging
import os
import re
import select
import socket
import sys
import threading
from typing import Any, NoReturn

import msgspec
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request

from hiernav.runtime import messages
from hiernav.runtime.observe import TickRecord
from hiernav.view.commands import MAX_BYTES, Asker, Command, Settings

OWN_HOST = re.compile(r"(127\.0\.0\.1|localhost)(:\d+)?")


def main(descriptor: int) -> None:
    """Serve the page until the loop goes away."""
    _refuse_other_sites()
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # whoever knocks and says nothing is no news
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


def is_own(headers: Headers) -> bool:
    """Whether a request comes from the page itself, or from a program that is no browser.

    A page is asked for under the host and port that its origin names, be it at the end of a tunnel with a port of its
    own; one of another server on this machine has another port.
    """
    origins, hosts = headers.get_all("Origin"), headers.get_all("Host")
    return not origins or origins == [f"http://{host}" for host in hosts if OWN_HOST.fullmatch(host)]


def _refuse_other_sites() -> None:
    """Let no web page from elsewhere, open in the same browser, talk to this server."""
    server = websockets.asyncio.server
    serve = server.serve

    def guarded(*arguments: Any, process_request: Any = None, **settings: Any) -> Any:
        def process(connection: ServerConnection, request: Request) -> Any:
            if not is_own(request.headers):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "this is for the page's own requests\n")
            return None if process_request is None else process_request(connection, request)

        return serve(*arguments, process_request=process, **settings)

    setattr(server, "serve", guarded)  # noqa: B010  # it is typed as a class


if __name__ == "__main__":
    main(int(sys.argv[1]))
