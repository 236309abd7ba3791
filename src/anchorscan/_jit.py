"""The one place where kernels are compiled.

numba's disk cache raises at import where no cache folder is writable (containers,
read-only installations); there a kernel is compiled anew in every process instead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

__all__ = ["kernel"]


def kernel(function: Callable[..., Any]) -> Any:
    """Compile ``function`` without Python objects, cached on disk where that is possible."""
    try:
        return numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:
        return numba.njit(nogil=True, error_model="numpy")(function)
