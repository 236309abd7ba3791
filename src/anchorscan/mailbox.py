"""What waits to be worked on: the newest map, and the newest few scans.

A slow worker loses old scans and never falls behind: what waits is bounded, and the oldest
falls out.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

__all__ = ["Closed", "Mailbox"]

Item = TypeVar("Item")


class Closed(Exception):  # noqa: N818 - the end of the work, not an error
    """There is nothing more to be done."""


class Mailbox:
    """Handed from one thread to another.

    Args:
        size: Scans that may wait.

    Attributes:
        is_closed: Whether the work is over.
        dropped: Scans that fell out.
    """

    def __init__(self, size: int) -> None:
        self._scans: deque[Any] = deque(maxlen=size)
        self._map: Any = None
        self._ready = threading.Condition()
        self.is_closed = False
        self.dropped = 0

    def put_scan(self, scan: Any) -> None:
        """Let a scan wait; the oldest falls out where there is no room."""
        with self._ready:
            self.dropped += len(self._scans) == self._scans.maxlen
            self._scans.append(scan)
            self._ready.notify()

    def put_map(self, grid: Any) -> None:
        """Let a map wait, instead of one that does already."""
        with self._ready:
            self._map = grid
            self._ready.notify()

    def take(self) -> Any:
        """Wait for what is to be done next: a map before scans, the oldest scan first.

        Raises:
            Closed: There is nothing more to be done.
        """
        with self._ready:
            self._ready.wait_for(lambda: self.is_closed or self._map is not None or self._scans)
            if self.is_closed:
                raise Closed
            if self._map is not None:
                grid, self._map = self._map, None
                return grid
            return self._scans.popleft()

    def forget_scans(self) -> None:
        """Let no scan wait any more."""
        with self._ready:
            self._scans.clear()

    def close(self) -> None:
        """Say that there is nothing more to be done."""
        with self._ready:
            self.is_closed = True
            self._ready.notify_all()

    def while_open(self, items: Iterable[Item]) -> Iterator[Item]:
        """Pass items on as long as the work is wanted.

        Raises:
            Closed: It is no more.
        """
        for item in items:
            if self.is_closed:
                raise Closed
            yield item
