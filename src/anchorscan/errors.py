"""The errors anchorscan raises on purpose, all under one base."""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "AnchorscanError",
    "LogError",
    "MissingExtraError",
    "ReferenceSetError",
    "ScanError",
    "ServiceError",
    "SettingsError",
]


# Names of files and what is quoted of them may hold anything, a line feed or a terminal's commands.
_CONTROL = {code: repr(chr(code))[1:-1] for code in (*range(32), *range(127, 160), 0x2028, 0x2029)}


class AnchorscanError(Exception):
    """Base of every error that anchorscan raises on purpose.

    The message is one line that says what is wrong and, where there is
    something to be done, what to do next.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(message.translate(_CONTROL))


class ScanError(AnchorscanError):
    """A laser scan that cannot be one: wrong shape, zero increment, and the like."""


class LogError(AnchorscanError):
    """A log, map or recording that cannot be read, with its path and line where known."""

    def __init__(self, message: str, path: Path | str | None = None, line: int | None = None):
        self.path = None if path is None else Path(path)
        self.line = line
        place = "" if path is None else f"{path}: " if line is None else f"{path}:{line}: "
        super().__init__(place + message)


class ReferenceSetError(AnchorscanError):
    """A reference set that cannot be opened, read or written."""


class ServiceError(AnchorscanError):
    """A service that cannot be reached, refuses, or answers what is no answer."""


class SettingsError(AnchorscanError):
    """A setting with an unknown name or an impossible value."""


class MissingExtraError(AnchorscanError):
    """An optional dependency that is not installed; the message holds the line to type."""

    def __init__(self, what: str, extra: str):
        super().__init__(f"{what} needs an optional dependency: pip install 'anchorscan[{extra}]'")
        self.extra = extra
