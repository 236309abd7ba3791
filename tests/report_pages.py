"""Runs to report, and what their pages hold, for the tests of the report."""

from __future__ import annotations

import base64
import json
import math
from html.parser import HTMLParser
from typing import Any

import numpy as np
from numpy.typing import NDArray

from anchorscan import LaserScan, Pose2D, Record, Reference
from anchorscan.answers import Guess, Run, ScanAnswer
from anchorscan.report import page

NASTY = "</script><script>document.title='owned'</script><img src=x onerror=alert(1)>\u2028&amp;'\""


def square_scan(half: float = 2.0, readings: int = 181) -> LaserScan:
    """What a laser sees in the middle of a square room."""
    angles = np.linspace(-math.pi / 2, math.pi / 2, readings)
    walls = np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    return LaserScan.from_field_of_view(half / walls, math.pi)


def reference(identifier: int, x: float = 0.0, half: float = 2.0) -> Reference:
    return Reference(identifier, square_scan(half), Pose2D(x, 0.0, 0.0))


def record(index: int, x: float = 0.0, half: float = 2.1, *, posed: bool = True) -> Record:
    return Record(index, square_scan(half), Pose2D(x, 0.0, 0.0) if posed else None)


def answer(
    scan: int,
    x: float = 0.0,
    probability: float = 0.9,
    *,
    accepted: bool = True,
    more: tuple[Guess, ...] = (),
    seconds: float = 0.001,
) -> ScanAnswer:
    guess = Guess(
        Pose2D(x, 0.0, 0.0), probability, reference=1, covariance=np.diag([0.01, 0.04, 0.001])
    )
    return ScanAnswer(scan, accepted, (guess, *more), float(scan), seconds)


def located(*answers: ScanAnswer, name: str = "office") -> Run:
    return Run("locate", name, answers)


def of(*records: Record) -> dict[str, Any]:
    return {"drive": lambda: iter(records)}


class _Page(HTMLParser):
    """Collects the elements of a page, and the texts of its scripts and styles."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.raw: dict[str, list[str]] = {"script": [], "style": [], "title": []}
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag in self.raw:
            self._inside = tag
            self.raw[tag].append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, text: str) -> None:
        if self._inside:
            self.raw[self._inside][-1] += text


def parsed(text: str) -> _Page:
    reader = _Page()
    reader.feed(text)
    reader.close()
    return reader


def data_of(text: str) -> Any:
    """Return the data of a page as a browser would read it."""
    return json.loads(parsed(text).raw["script"][0])


def data(*arguments: Any, **words: Any) -> Any:
    return data_of(page(*arguments, **words))


def decoded(text: str, kind: str = "<u2") -> NDArray[np.float64]:
    return np.frombuffer(base64.b64decode(text), kind).astype(np.float64)
