"""The page of a guided calibration, for this machine alone: on 127.0.0.1, under a random token, with one request that changes
anything."""

import json
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from camera_models import InputError
from omnilines.guide.drawing import live_picture, map_picture
from omnilines.guide.session import Session
from omnilines.report.page import fragment

HOST = "127.0.0.1"
TOKEN_BYTES = 16
REQUEST_S = 10.0
"""Within which a request has to be there."""


def state_of(session: Session) -> dict[str, Any]:
    """What the page says, as JSON."""
    known = session.known
    state: dict[str, Any] = {
        "offered": session.offered,
        "kept": len(session.kept),
        "message": session.message,
        "over": session.over.is_set(),
        "until_px": session.options.until_px,
        "calibrated": known is not None,
    }
    if known is not None:
        advice = known.advice
        state |= {
            "worst_px": advice.worst_px,
            "worst_where": advice.worst_where,
            "median_px": advice.median_px,
            "worst": f"{advice.worst_words} {advice.worst_where}",
            "median": advice.median_words,
            "rms_px_per_axis": known.result.rms_px_per_axis,
            "max_angle_deg": known.result.fit.max_angle_deg,
            "limits": list(advice.limits),
            "next": advice.sentences[0] if advice.poses else advice.conclusion,
        }
    return state


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a browser that goes away in the middle of an answer is no error."""


@contextmanager
def served(session: Session, port: int = 0) -> Iterator[str]:
    """The address of the page, for as long as it is shown; port 0: any that is free. Raises InputError where it is taken."""
    token = secrets.token_urlsafe(TOKEN_BYTES)
    try:
        server = _Server((HOST, port), _handler(session, token))
    except (OSError, OverflowError) as error:
        why = "there are ports up to 65535" if isinstance(error, OverflowError) else error.strerror
        raise InputError(f"A free `port` was expected, found that {port} cannot be used ({why}); give another.") from None
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}/{token}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _handler(session: Session, token: str) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """One request."""

        server_version, sys_version = "omnilines", ""
        timeout = REQUEST_S

        def do_GET(self) -> None:
            """The page, its pictures and its figures; all else is not found."""
            asked = self._asked()
            if asked == "":
                self._send("text/html; charset=utf-8", str(fragment("guide")).encode())
            elif asked == "state.json":
                self._send("application/json", json.dumps(state_of(session), allow_nan=False).encode())
            elif asked == "live.jpg":
                self._send("image/jpeg", live_picture(session))
            elif asked == "map.jpg":
                self._send("image/jpeg", map_picture(session))
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def do_POST(self) -> None:
            """`finish`: the guide is over."""
            if self._asked() == "finish":
                session.over.set()
                self._send("application/json", b"{}")
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _asked(self) -> str | None:
            """What stands behind the token; None where it is another one, or a page of elsewhere asks in our name."""
            assert isinstance(self.server, ThreadingHTTPServer)
            own = {f"{name}:{self.server.server_port}" for name in (HOST, "localhost")}
            given, _, rest = self.path.partition("?")[0].removeprefix("/").partition("/")
            right = secrets.compare_digest(given.encode(), token.encode())
            return rest if right and self.headers.get("Host") in own else None

        def _send(self, kind: str, body: bytes) -> None:
            self.send_response(HTTPStatus.OK)
            for name, value in (
                ("Content-Type", kind),
                ("Content-Length", str(len(body))),
                ("Cache-Control", "no-store"),
                ("Referrer-Policy", "no-referrer"),
                ("X-Content-Type-Options", "nosniff"),
            ):
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: the terminal has its own lines."""

    return Handler
