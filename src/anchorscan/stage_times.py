"""Where the time of a query goes, stage by stage, measured from outside.

The algorithm holds no timing code.  While the clock runs, every public function and method of a
stage is replaced, wherever the package has imported it, by one that notes its time; the time of
a stage called by another counts for the inner one only.  The clock is for one thread, and for
kernels that are compiled already.
"""

from __future__ import annotations

import functools
import inspect
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any

__all__ = ["STAGES", "stage_times"]

STAGES: Mapping[str, str] = {
    "angle_function": "extraction",
    "segments": "extraction",
    "anchors": "extraction",
    "graph": "extraction",
    "description": "extraction",
    "database": "search",
    "panorama": "search",
    "spacing": "search",
    "proposal": "search",
    "alignment": "alignment",
    "evaluation": "evaluation",
    "verification": "evaluation",
    "decision": "decision",
    "verification._fit": "refinement",
    "stitched_map.compared": "evaluation",
}
"""The stage of each module, and of single functions that do the work of another stage."""

_PACKAGE = __name__.rpartition(".")[0]


@contextmanager
def stage_times(stages: Mapping[str, str] = STAGES) -> Iterator[dict[str, float]]:
    """Note the seconds spent in each stage while the context lasts.

    Args:
        stages: Stage of each module (and of single functions) by name.

    Yields:
        Seconds by stage, summed over all calls so far.
    """
    clock = _Clock({stage: 0.0 for stage in stages.values()})
    with ExitStack() as patches:
        for holder, name, timed in _replacements(clock, stages):
            patches.callback(setattr, holder, name, vars(holder)[name])
            setattr(holder, name, timed)
        yield clock.seconds


class _Clock:
    """Sums the time of each stage, without that of the stages called from it."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds = seconds
        self._inner = [0.0]

    def timed(self, function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        @functools.wraps(function)
        def run(*args: Any, **kwargs: Any) -> Any:
            self._inner.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **kwargs)
            finally:
                elapsed = time.perf_counter() - start
                self.seconds[stage] += elapsed - self._inner.pop()
                self._inner[-1] += elapsed

        return run


def _replacements(
    clock: _Clock, stages: Mapping[str, str]
) -> Iterator[tuple[Any, str, Callable[..., Any]]]:
    """Give (holder, name, timed function) for every place where a stage's function is known."""
    loaded = [
        module for name, module in sys.modules.items() if name.startswith(f"{_PACKAGE}.") and module
    ]
    for key, stage in stages.items():
        home, _, single = key.partition(".")
        module = sys.modules.get(f"{_PACKAGE}.{home}")
        if module is None:
            continue
        for name, value in _timed_values(module, single, stages):
            if inspect.isclass(value):
                for method, function in _methods(value):
                    yield value, method, clock.timed(function, stage)
                continue
            timed = clock.timed(value, stage)
            for holder in loaded:
                if vars(holder).get(name) is value:
                    yield holder, name, timed


def _timed_values(
    module: ModuleType, single: str, stages: Mapping[str, str]
) -> list[tuple[str, Any]]:
    """Return what to time of one module: a single function, or all that is public in it."""
    if single:
        return [(single, value)] if (value := vars(module).get(single)) is not None else []
    home = module.__name__.rpartition(".")[2]
    return [
        (name, value)
        for name, value in vars(module).items()
        if getattr(value, "__module__", "") == module.__name__
        and not name.startswith("_")
        and f"{home}.{name}" not in stages
        and (inspect.isfunction(value) or inspect.isclass(value))
    ]


def _methods(owner: type) -> list[tuple[str, Callable[..., Any]]]:
    return [
        (name, value)
        for name, value in vars(owner).items()
        if inspect.isfunction(value) and not name.startswith("_")
    ]
