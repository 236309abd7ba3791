"""The one place where kernels are compiled.

numba's disk cache raises at import where no cache folder is writable (containers,
read-only installations); there a kernel is compiled anew in every process instead.

numba takes a cached kernel for current as long as its own file is unchanged, although the
kernels and constants that it uses from other files are compiled into it.  So the stamp of a
kernel's file is joined here with the stamps of what its module imports.

A first search compiles for a minute or two; who wonders why it takes so long is told by a line
of information in the log of this module.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from enum import EnumMeta
from hashlib import blake2b
from typing import Any

import numba
from numba.core import event
from numba.core.dispatcher import Dispatcher

__all__ = ["inlined", "kernel"]

_LOG = logging.getLogger(__name__)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile ``function`` without Python objects, cached on disk where that is possible."""
    return _compiled(function, forceinline=False)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile ``function`` into every kernel that calls it.

    For what is called in inner loops and is too large for the compiler to do that by itself:
    a call hands over every field of every array, which may cost more than the function does.
    """
    return _compiled(function, forceinline=True)


def _compiled(function: Callable[..., Any], forceinline: bool) -> Any:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "forceinline": forceinline}
    try:
        compiled: Any = numba.njit(cache=True, **options)(function)
        file = compiled._cache._cache_file
        file._source_stamp = (file._source_stamp, _borrowed(function.__globals__))
    except (RuntimeError, AttributeError):  # AttributeError: a numba that caches in another way
        return numba.njit(**options)(function)
    return compiled


def _borrowed(names: Mapping[str, Any]) -> str:
    """Sign the numbers and the kernels that a module knows so far, its imports above all."""
    signature = blake2b(digest_size=16)
    for name, value in sorted(names.items()):
        if isinstance(value, Dispatcher):
            cache_file = getattr(getattr(value, "_cache", None), "_cache_file", None)
            held: Any = getattr(cache_file, "_source_stamp", None)
        elif isinstance(value, EnumMeta):
            held = list(value.__members__.items())
        elif isinstance(value, (bool, int, float, tuple)):
            held = value
        else:
            continue
        signature.update(f"{name}={held!r}\n".encode())
    return signature.hexdigest()


class _Announcer(event.Listener):
    """Logs once in a process that kernels are compiled which no cache had."""

    def __init__(self) -> None:
        self._silent = False

    def on_start(self, event: Any) -> None:
        """Hear that a function is about to be compiled."""
        module = str(event.data["dispatcher"].py_func.__module__)
        if not self._silent and module.partition(".")[0] == __package__:
            self._silent = True
            _LOG.info("compiling for the first use, which takes one or two minutes, once")

    def on_end(self, event: Any) -> None:
        """Hear that it was compiled."""


event.register("numba:compile", _Announcer())  # type: ignore[no-untyped-call]
