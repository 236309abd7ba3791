"""A reference set on another machine, called as one in this process.

``RemoteSet("http://host:8000", "office")`` has ``locate``, ``locate_batch``, ``add`` and
``add_batch`` of `ReferenceSet` with the same arguments and the same values back, so that moving
from one to the other changes one line.  What an answer has beyond that, the version of the
set, is kept as ``version``.

Of the standard library alone: a robot needs nothing but the core of this package.  One connection
stays open for every thread that calls.  A question that finds it closed by the other side is
asked once more on a new one; a write is not repeated, since it may have been done.
"""

from __future__ import annotations

import http.client
import json
import threading
from collections.abc import Iterable, Sequence
from typing import Any
from urllib.parse import quote, urlsplit

from .errors import ServiceError
from .hypothesis import Hypothesis
from .pose import Pose2D
from .scan import LaserScan
from .scan_message import BINARY, hypothesis_of, packed, scan_values

__all__ = ["RemoteSet"]

_SCHEMES = {"http": http.client.HTTPConnection, "https": http.client.HTTPSConnection}
_JSON = "application/json"
_LONGEST_REASON = 300


class RemoteSet:
    """A reference set that ``anchorscan serve`` has.

    Args:
        url: Where the service is: ``http://host:8000``, or a longer address before which a proxy
            stands.
        name: Of the set.
        token: What the service wants to see, if it does.
        seconds: To wait for the next part of an answer.

    Raises:
        ServiceError: The address is none, or the token is not one line of printable ASCII.
    """

    def __init__(
        self, url: str, name: str, *, token: str | None = None, seconds: float = 30.0
    ) -> None:
        try:
            parts = urlsplit(url)
            port = parts.port
            (parts.hostname or "").encode("idna")
        except ValueError:  # UnicodeError is one
            parts, port = urlsplit(""), None
        if parts.scheme not in _SCHEMES or not parts.hostname:
            raise ServiceError(f"{url!r} is not the address of a service: http://host:port")
        token = None if token is None else token.strip()  # of a file, it ends with a line feed
        if token is not None and not (token.isascii() and token.isprintable()):
            raise ServiceError("the token must be one line of printable ASCII")
        self.name = name
        self.version = ""
        self._address = (parts.scheme, parts.hostname, port)
        path = quote(parts.path.rstrip("/"), safe="/%")
        self._place = f"{path}/sets/{quote(name, safe='')}"
        self._token = token
        self._seconds = seconds
        self._thread = threading.local()

    def locate(self, scan: LaserScan) -> list[Hypothesis]:
        """Find where a scan may have been taken, as `ReferenceSet.locate` does.

        Raises:
            ServiceError: The service cannot be reached, or refuses; the reason is in one line.
        """
        return self._hypotheses(self._ask("/locate", BINARY, packed([scan])))

    def locate_batch(self, scans: Iterable[LaserScan]) -> list[list[Hypothesis]]:
        """Find where each of many scans may have been taken, each on its own, in one version.

        Raises:
            ServiceError: As for ``locate``; also for more scans than the service takes at once.
        """
        scans = list(scans)
        if not scans:
            return []
        answer = self._ask("/locate-batch", BINARY, packed(scans))
        return [self._hypotheses(each) for each in self._of(answer, "answers", len(scans))]

    def add(self, scan: LaserScan, pose: Pose2D | None = None, name: str = "") -> int:
        """Add a reference; it is on disk there when this returns.

        Args:
            scan: The laser scan.
            pose: ``T_set_laser``; None in a topological set.
            name: What the user calls the place.

        Returns:
            Its identifier.

        Raises:
            ServiceError: As for ``locate``.  Where no answer came, it may have been added.
        """
        return self.add_batch([scan], [pose], [name])[0]

    def add_batch(
        self,
        scans: Sequence[LaserScan],
        poses: Sequence[Pose2D | None] | None = None,
        names: Sequence[str] | None = None,
    ) -> list[int]:
        """Add references, all or none.

        Returns:
            Their identifiers, rising.

        Raises:
            ServiceError: As for ``add``, and where the lengths differ.
        """
        poses = [None] * len(scans) if poses is None else poses
        names = [""] * len(scans) if names is None else names
        if not len(scans) == len(poses) == len(names):
            raise ServiceError(
                f"{len(scans)} scans, {len(poses)} poses and {len(names)} names do not go together"
            )
        references = [
            {
                "scan": scan_values(scan),
                "pose": None if pose is None else {"x": pose.x, "y": pose.y, "theta": pose.theta},
                "name": name,
            }
            for scan, pose, name in zip(scans, poses, names, strict=True)
        ]
        try:
            body = json.dumps({"references": references}, allow_nan=False).encode()
        except ValueError:
            raise ServiceError("the pose of a reference must be finite") from None
        answer = self._ask("/references", _JSON, body, is_question=False)
        identifiers = self._of(answer, "identifiers", len(scans))
        if not all(isinstance(each, int) for each in identifiers):
            raise ServiceError(f"{self._where()}: an answer of another kind: no identifiers")
        return list(identifiers)

    def close(self) -> None:
        """Close the connection of this thread; the next call opens another."""
        connection = getattr(self._thread, "connection", None)
        if connection is not None:
            connection.close()
            self._thread.connection = None

    def __enter__(self) -> RemoteSet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<RemoteSet {self.name!r} at {self._address[1]}>"

    def _ask(self, path: str, kind: str, body: bytes, *, is_question: bool = True) -> Any:
        headers = {"Content-Type": kind, "Accept": _JSON}
        if self._token is not None:
            headers["Authorization"] = f"Bearer {self._token}"
        if not is_question:
            self.close()  # a new connection cannot have been closed while it was idle
        status, data = self._send(self._place + path, body, headers, again=is_question)
        try:
            answer = json.loads(data)
        except (ValueError, RecursionError):
            answer = None
        if status >= 400 or not isinstance(answer, dict):
            raise ServiceError(f"{self._where()}: {_reason(status, answer)}")
        self.version = str(answer.get("version", ""))
        return answer

    def _send(
        self, path: str, body: bytes, headers: dict[str, str], *, again: bool
    ) -> tuple[int, bytes]:
        was_open = getattr(self._thread, "connection", None) is not None
        try:
            connection = self._connection()
            connection.request("POST", path, body, headers)
            response = connection.getresponse()
            return response.status, response.read()
        except (OSError, http.client.HTTPException) as error:
            self.close()
            is_late = isinstance(error, TimeoutError)
            if again and was_open and not is_late:
                return self._send(path, body, headers, again=False)
            reason = f"no answer within {self._seconds:g} s" if is_late else _said(error)
            raise ServiceError(f"{self._where()}: {reason}") from None

    def _connection(self) -> http.client.HTTPConnection:
        connection: http.client.HTTPConnection | None = getattr(self._thread, "connection", None)
        if connection is None:
            scheme, host, port = self._address
            connection = _SCHEMES[scheme](host, port, timeout=self._seconds)
            self._thread.connection = connection
        return connection

    def _hypotheses(self, answer: Any) -> list[Hypothesis]:
        try:
            return [hypothesis_of(each) for each in self._of(answer, "hypotheses")]
        except (ValueError, OverflowError) as error:
            raise ServiceError(f"{self._where()}: an answer of another kind: {error}") from None

    def _of(self, answer: Any, name: str, count: int | None = None) -> list[Any]:
        """Return a list of an answer, of so many values."""
        found = answer.get(name) if isinstance(answer, dict) else None
        if not isinstance(found, list):
            raise ServiceError(f"{self._where()}: an answer of another kind: no {name}")
        if count not in (None, len(found)):
            raise ServiceError(f"{self._where()}: {len(found)} {name} where {count} were asked for")
        return found

    def _where(self) -> str:
        scheme, host, port = self._address
        return f"{scheme}://{host}{'' if port is None else f':{port}'}{self._place}"


def _reason(status: int, answer: Any) -> str:
    if isinstance(answer, dict) and isinstance(answer.get("error"), str):
        return str(answer["error"])[:_LONGEST_REASON]
    return f"answers {status}, and not as a service of anchorscan does"


def _said(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)
