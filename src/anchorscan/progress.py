"""How work that takes a while tells its caller how far it is; the library itself shows nothing."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol, TypeVar

__all__ = ["ProgressOf"]

Item = TypeVar("Item")


class ProgressOf(Protocol):
    """How the caller shows progress: passes items on."""

    def __call__(
        self, items: Iterable[Item], what: str, total: int | None = None
    ) -> Iterable[Item]:
        """Pass on the items of ``what``, ``total`` of them where that is known."""
