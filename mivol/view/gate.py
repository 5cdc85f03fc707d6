"""Who may open the page: the loopback address only, a token, and the names of this machine.

Reason. Any program of this machine, and any web page in a browser of it, can reach a port of the loopback address. A request
passes with the token in its address (``/?token=...``) or in the cookie that the answer to such a request sets; with a ``Host``
of this machine (a foreign name that resolves to 127.0.0.1 is the attack called DNS rebinding); and, from a browser, with an
``Origin`` of the page itself (pages may open web sockets to any host).
"""

from __future__ import annotations

import hmac
import http
import urllib.parse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

LOOPBACK = "127.0.0.1"

HOSTS = (LOOPBACK, "localhost")


def find_fault(path: str, headers: Mapping[str, str], token: str, port: int) -> str:
    """Why a request is turned away; empty for a request that passes.

    Args:
        path: of the request, with the query.
        headers: of the request; ``Host``, ``Origin`` and ``Cookie`` count.
        token: of the page.
        port: of the page.
    """
    places = [f"{host}:{port}" for host in HOSTS]
    if headers.get("Host", "").lower() not in places:
        return f"found another host, expected {places[0]}"
    origin = headers.get("Origin")
    if origin is not None and origin.lower() not in [f"http://{place}" for place in places]:
        return "found a request of another page, expected one of this page"
    given = [*urllib.parse.parse_qs(urllib.parse.urlsplit(path).query).get("token", [])]
    for part in headers.get("Cookie", "").split(";"):
        name, _, value = part.strip().partition("=")
        given += [value] if name == cookie_name(port) else []
    if not any(hmac.compare_digest(word.encode(), token.encode()) for word in given):
        return "found no token or a wrong one, expected the whole address that mivol view printed"
    return ""


def cookie_name(port: int) -> str:
    """Name of the cookie with the token; cookies know no ports, so the name has it."""
    return f"mivol_view_{port}"


@contextmanager
def guard_server(token: str, port: Callable[[], int]) -> Iterator[None]:
    """Put the gate before every server of ``websockets`` that starts meanwhile.

    viser has no option for it. Whoever starts a server here asks it afterwards for a page without a token, and stops if the
    answer is not a refusal.

    Args:
        token: of the page.
        port: returns the port of the server, known once it listens.
    """
    from websockets.asyncio import server

    original = server.serve

    def serve(*args: Any, process_request: Callable, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            fault = find_fault(request.path, request.headers, token, port())
            if fault:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f"{fault}\n")
            response = process_request(connection, request)
            if response is not None:
                response.headers["Set-Cookie"] = f"{cookie_name(port())}={token}; HttpOnly; SameSite=Strict; Path=/"
                response.headers["Cache-Control"] = "no-store"
            return response

        return original(*args, process_request=answer, **options)

    server.serve = serve
    try:
        yield
    finally:
        server.serve = original
