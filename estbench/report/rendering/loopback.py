"""MuJoCo's web viewer on loopback only: where it listens, and by which names it may be asked for.

A page of another site can make a browser send requests to 127.0.0.1 under its own name (DNS
rebinding), and open websockets to it. Both are refused by their `Host` and `Origin`.
"""

import ipaddress
import socket
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

from estbench.errors import EstbenchError
from estbench.report.rendering.player import KEYS

LOOPBACK = "127.0.0.1"


class ViewError(EstbenchError):
    """The live view cannot be shown."""


def is_loopback(host: str) -> bool:
    """Whether `host` or `host:port` names this machine's loopback."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name == "localhost" or ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def allowed(headers: Mapping[str, str]) -> bool:
    """Whether a request names loopback as its host, and as the origin of its page if it has one."""
    origin = headers.get("Origin")
    own = origin is None or is_loopback(urlsplit(origin).netloc)
    return own and is_loopback(headers.get("Host", ""))


@contextmanager
def only() -> Iterator[str]:
    """Make MuJoCo's web viewer serve loopback only; by default it serves the whole network.

    The viewer binds its port, announces it and listens later; until then another viewer can bind
    the same port (`SO_REUSEADDR`). Therefore the socket listens as soon as it is bound. The page
    and its websockets are served at one port.

    Raises:
        ViewError: the viewer of this MuJoCo cannot be restricted to loopback.
    """
    from mujoco.studio import web_viewer
    from mujoco.studio.web import web_server

    banner, serve = (
        getattr(module, name, None)
        for module, name in ((web_viewer, "_print_url_banner"), (web_server, "serve"))
    )
    bind = web_server.bind_public_socket
    if banner is None or serve is None:
        raise ViewError("this MuJoCo's web viewer cannot be kept on loopback; use --window")

    def announce(host: str, port: int) -> None:
        print(f"estbench view: http://{LOOPBACK}:{port}/  (Ctrl-C ends it)")
        for key, what in KEYS.items():
            print(f"  {key:8} {what}")
        sys.stdout.flush()

    def listening(host: str, port: int = 0) -> socket.socket:
        while True:
            sock = bind(LOOPBACK, port)
            try:
                sock.listen()
                return sock
            except OSError:  # another viewer listens by now, and `bind` takes the next port
                sock.close()

    def guarded(*arguments: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def process(connection: Any, request: Any) -> Any:
            if not allowed(request.headers):
                return connection.respond(HTTPStatus.FORBIDDEN, "only loopback names\n")
            return process_request(connection, request)

        return serve(*arguments, process_request=process, **options)

    replaced: tuple[Any, Any] = web_server, web_viewer
    replaced[0].bind_public_socket, replaced[0].serve = listening, guarded
    replaced[1]._print_url_banner = announce
    try:
        yield LOOPBACK
    finally:
        replaced[0].bind_public_socket, replaced[0].serve = bind, serve
        replaced[1]._print_url_banner = banner
