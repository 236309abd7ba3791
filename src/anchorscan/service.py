"""``anchorscan serve``: reference sets over HTTP.

Every worker is a process with two threads: one speaks HTTP, the other has the sets (``shelf.py``),
reads, searches and writes.  Since only that thread touches a set, an answer is always of one
version of it, which it carries, and a batch, too.  Workers share nothing but the files, so that a
worker can be killed at any time: what was accepted is on disk, the others go on, and a new
worker takes its place.

Refused are: requests without a token where there are tokens, writes with a token to read, hosts
other than this machine's own names where there are none (a page in a browser could ask else), too
large and too slow requests, and more requests than can be answered in time.  What is wrong with a
request is said in one line, ``{"error": "..."}``.  No header allows another origin.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import json
import logging
import math
import os
import socket
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic_core import to_json

from .errors import AnchorscanError, MissingExtraError, ScanError, SettingsError
from .fleet import BuildingHypothesis
from .reference_set import ReferenceSet
from .scan import LaserScan
from .scan_message import BINARY, hypothesis_values, state_values, unpacked
from .service_message import (
    AddedOut,
    BatchIn,
    BatchOut,
    ErrorOut,
    HealthOut,
    LocatedOut,
    ReferencesIn,
    ScanIn,
    SetOut,
    SetsOut,
    WhichOut,
)
from .set_file import Place
from .shelf import NAME, Kept, Shelf, UnknownSetError

try:
    import uvicorn
    from fastapi import Depends, FastAPI, HTTPException, Request
    from fastapi import Path as InPath
    from fastapi.exceptions import RequestValidationError
    from fastapi.responses import HTMLResponse, JSONResponse, Response
    from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
    from prometheus_client import (
        CONTENT_TYPE_LATEST,
        CollectorRegistry,
        Counter,
        Histogram,
        generate_latest,
        multiprocess,
    )
    from starlette.exceptions import HTTPException as AnyHTTPException
    from uvicorn.protocols.http.auto import AutoHTTPProtocol
except ImportError as error:
    raise MissingExtraError("the service", "service") from error

__all__ = [
    "ServiceOptions",
    "Token",
    "application",
    "application_of_worker",
    "read_tokens",
    "serve",
]

TOKENS_VARIABLE = "ANCHORSCAN_TOKENS"
"""Environment variable that holds tokens where no file is named."""

_OPTIONS_VARIABLE = "ANCHORSCAN_SERVICE"
_SHORTEST_TOKEN = 16
# Seconds in which a worker answers: on a busy machine one that only starts was taken for dead.  As
# long the service may wait for one that was killed while it was asked, so not much longer.
_SLOWEST_START = 20
_LOOPBACK = {"127.0.0.1", "localhost", "::1"}
_METRICS_FOLDER = "PROMETHEUS_MULTIPROC_DIR"
_SQLITE = "application/vnd.sqlite3"
_OCTETS = "application/octet-stream"
_JSON = "application/json"
_OUTCOMES = {"unknown": "not known"}
_LOG = logging.getLogger("anchorscan.service")

Result = TypeVar("Result")
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]


@dataclass(frozen=True)
class Token:
    """A secret, and what it allows.

    Args:
        secret: What the client sends.
        may_write: Whether it also may add references and upload sets.
    """

    secret: str
    may_write: bool

    def __repr__(self) -> str:
        return f"Token(may_write={self.may_write})"  # never the secret


@dataclass(frozen=True)
class ServiceOptions:
    """What a service is told.

    Args:
        folder: NAME.apr in it is the set NAME.
        tokens: Without any, only this machine is answered.
        largest_request: Bytes of a request.
        seconds: Time for a request, from its first byte to the answer.
        most_scans: Scans, or references, of a request.
        waiting: Requests that a worker lets wait; more are told to come back.
    """

    folder: Path
    tokens: tuple[Token, ...] = ()
    largest_request: int = 64 << 20
    seconds: float = 30.0
    most_scans: int = 1000
    waiting: int = 64


def read_tokens(path: Path | None) -> tuple[Token, ...]:
    """Read tokens from a file, or from ANCHORSCAN_TOKENS where none is named.

    A line is ``read SECRET`` or ``write SECRET``; empty lines and lines with ``#`` say nothing.

    Raises:
        SettingsError: A line is another, or a secret is shorter than 16 characters; the
            message does not hold it.
        OSError: The file cannot be read.
    """
    if path is None:
        text, where = os.environ.get(TOKENS_VARIABLE, ""), TOKENS_VARIABLE
    else:
        text, where = path.read_text(encoding="utf-8", errors="replace"), str(path)
    tokens = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) != 2 or words[0] not in ("read", "write"):
            raise SettingsError(f"{where}:{number}: a line is 'read TOKEN' or 'write TOKEN'")
        if len(words[1]) < _SHORTEST_TOKEN:
            raise SettingsError(
                f"{where}:{number}: a token has at least {_SHORTEST_TOKEN} characters"
            )
        tokens.append(Token(words[1], words[0] == "write"))
    if path is not None and not tokens:
        raise SettingsError(f"{path}: holds no token")
    return tuple(tokens)


def serve(
    options: ServiceOptions,
    host: str = "127.0.0.1",
    port: int = 8000,
    workers: int = 1,
    say: Callable[[str], None] = lambda line: None,
) -> None:
    """Answer until told to stop (SIGINT, SIGTERM).

    Args:
        options: What to serve, and to whom.
        host: Address to listen at.
        port: Port.
        workers: Processes.
        say: Takes a line with the address, once it is known.

    Raises:
        SettingsError: The address is not this machine's own, and there are no tokens.
        ReferenceSetError: There is no such folder.
        OSError: The address cannot be had.
    """
    Shelf(options.folder)
    if host not in _LOOPBACK and not options.tokens:
        raise SettingsError(
            f"without tokens only this machine is answered: name a file with --tokens, or listen "
            f"at 127.0.0.1 instead of {host}"
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family):
        pass  # in use, or not ours: said before workers start
    shown = f"[{host}]" if ":" in host else host
    say(f"serving {options.folder} at http://{shown}:{port}")
    with tempfile.TemporaryDirectory(prefix="anchorscan-metrics-") as folder:
        os.environ[_METRICS_FOLDER] = folder  # before a worker loads prometheus_client
        os.environ[_OPTIONS_VARIABLE] = _as_json(options)
        os.environ[TOKENS_VARIABLE] = _as_text(options.tokens)
        uvicorn.run(
            "anchorscan.service:application_of_worker",
            factory=True,
            host=host,
            port=port,
            workers=workers,
            http=_Prompt,
            access_log=False,
            log_level="warning",
            server_header=False,
            timeout_keep_alive=75,
            timeout_graceful_shutdown=math.ceil(options.seconds),
            timeout_worker_healthcheck=_SLOWEST_START,
        )


class _Prompt(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """Sends at once what there is to send.

    asyncio sees to that only on sockets that it has opened itself, which those that several workers
    share are not: there every answer would wait 40 ms for an acknowledgement.
    """

    def connection_made(self, transport: Any) -> None:
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().connection_made(transport)


def application_of_worker() -> FastAPI:
    """Make the application as ``serve`` has left word in the environment of its workers."""
    values = json.loads(os.environ[_OPTIONS_VARIABLE])
    values["folder"] = Path(values["folder"])
    return application(ServiceOptions(**values, tokens=read_tokens(None)))


def _as_json(options: ServiceOptions) -> str:
    """All but the tokens."""
    values = {each.name: getattr(options, each.name) for each in fields(options)}
    del values["tokens"]
    return json.dumps({**values, "folder": str(options.folder.absolute())})


def _as_text(tokens: Sequence[Token]) -> str:
    """Tokens for a process of the same user: seen by nobody else, unlike a command line."""
    return "\n".join(f"{'write' if each.may_write else 'read'} {each.secret}" for each in tokens)


_SCAN = TypeAdapter(ScanIn)
_BATCH = TypeAdapter(BatchIn)
_REFERENCES = TypeAdapter(ReferencesIn)


class _Desk:
    """The one thread of a worker that has the sets, and the queue before it."""

    def __init__(self, options: ServiceOptions) -> None:
        self.options = options
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="sets")
        self._shelf: Shelf | None = None
        self._waiting = 0

    async def start(self) -> None:
        """Compile what the first request would wait for, and read the sets that are there."""
        await asyncio.get_running_loop().run_in_executor(self._thread, self._open)

    async def stop(self) -> None:
        """Let go of the files."""
        if self._shelf is not None:
            await asyncio.get_running_loop().run_in_executor(self._thread, self._shelf.close)
        self._thread.shutdown()

    async def do(
        self,
        work: Callable[[Shelf, float], Result],
        deadline: float,
        *,
        is_question: bool = True,
    ) -> Result:
        """Do some work with the sets, in turn.

        A change that has begun is waited for: who is told that it was not done would do it again.

        Raises:
            HTTPException: Too many wait already, or it was not done in time.
        """
        assert self._shelf is not None
        if self._waiting >= self.options.waiting:
            raise HTTPException(503, "too many requests are waiting", {"Retry-After": "1"})
        self._waiting += 1
        try:
            job = self._thread.submit(work, self._shelf, deadline)
            result = asyncio.wrap_future(job)
            left = max(deadline - time.monotonic(), 0.001)
            await asyncio.wait([result], timeout=left)
            if not result.done() and (is_question or job.cancel()):
                result.cancel()
                raise _too_slow(self.options)
            return await result
        finally:
            self._waiting -= 1

    def _open(self) -> None:
        shelf = Shelf(self.options.folder)
        ReferenceSet().prepare()
        for name in shelf.names():
            try:
                _index(shelf.take(name))
            except AnchorscanError as error:
                _LOG.warning("%s", error)
        self._shelf = shelf


def _index(kept: Kept) -> Kept:
    """Derive what the first query of a set would wait for."""
    if len(kept.places):
        kept.places.locate(_BLANK)
    return kept


_BLANK = LaserScan(np.array([np.inf], np.float32), 0.0, 0.1)


def _too_slow(options: ServiceOptions) -> HTTPException:
    return HTTPException(
        503, f"not done within {options.seconds:g} s: ask for less at once", {"Retry-After": "1"}
    )


def application(options: ServiceOptions) -> FastAPI:
    """Make the application of one worker.

    Args:
        options: What to serve, and to whom.
    """
    from . import __version__

    desk, metrics = _Desk(options), _Metrics()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        await desk.start()
        yield
        await desk.stop()

    app = FastAPI(
        title="anchorscan",
        summary="Where a robot is, from one 2D laser scan and no prior guess.",
        version=__version__,
        docs_url=None,  # they load scripts from other sites
        redoc_url=None,
        lifespan=lifespan,
        responses=_errors(400, 401),
    )
    counter = _Counter(options, desk, metrics, *_rights(options.tokens))
    _tell_of_itself(app, counter)
    _keep_sets(app, counter)
    _locate_scans(app, counter)
    _handle_errors(app, options.folder)
    app.add_middleware(_Gate, options=options, metrics=metrics)
    return app


@dataclass(frozen=True, eq=False)
class _Counter:
    """What the calls have at hand.

    Args:
        options: What to serve, and to whom.
        desk: Where the sets are.
        metrics: Where answers are counted.
        reading: What lets a reader pass.
        writing: What lets a writer pass.
    """

    options: ServiceOptions
    desk: _Desk
    metrics: _Metrics
    reading: list[Any]
    writing: list[Any]

    @property
    def deadline(self) -> float:
        """When a request that comes now must be answered."""
        return time.monotonic() + self.options.seconds


_Name = Annotated[str, InPath(pattern=NAME, description="Name of a set")]


def _rights(tokens: Sequence[Token]) -> tuple[list[Any], list[Any]]:
    bearer = HTTPBearer(auto_error=False, description="A token to read or to write.")

    # Coroutines, since FastAPI sends plain functions to a thread, which costs more than they do.
    async def may_read(given: HTTPAuthorizationCredentials | None = Depends(bearer)) -> None:  # noqa: B008 - how FastAPI writes it
        _allow(tokens, given, to_write=False)

    async def may_write(given: HTTPAuthorizationCredentials | None = Depends(bearer)) -> None:  # noqa: B008 - as above
        _allow(tokens, given, to_write=True)

    return [Depends(may_read)], [Depends(may_write)]


def _tell_of_itself(app: FastAPI, at: _Counter) -> None:
    """Health, metrics, and the page that describes the calls."""

    @app.get("/health", tags=["service"])
    async def health() -> HealthOut:
        """Say that requests are answered; needs no token."""
        names = await at.desk.do(lambda shelf, _: shelf.names(), at.deadline)
        return HealthOut(status="ok", sets=len(names), version=app.version)

    @app.get(
        "/metrics",
        tags=["service"],
        dependencies=at.reading,
        response_class=Response,
        responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    )
    async def prometheus() -> Response:
        """Give metrics in the text format of Prometheus, of all workers."""
        return Response(at.metrics.text(), media_type=CONTENT_TYPE_LATEST)

    @app.get("/docs", include_in_schema=False)
    async def page() -> HTMLResponse:
        return HTMLResponse(_page(app))


def _keep_sets(app: FastAPI, at: _Counter) -> None:
    """List, show, upload sets, and add references to them."""

    @app.get("/sets", tags=["sets"], dependencies=at.reading)
    async def list_sets() -> SetsOut:
        """List the sets."""
        return await at.desk.do(_list, at.deadline)

    @app.get("/sets/{name}", tags=["sets"], dependencies=at.reading, responses=_errors(404, 422))
    async def show_set(name: _Name) -> SetOut:
        """Show one set."""
        return await at.desk.do(lambda shelf, _: _shown(shelf.take(name)), at.deadline)

    @app.put(
        "/sets/{name}",
        tags=["sets"],
        dependencies=at.writing,
        status_code=200,
        responses={
            201: {"model": SetOut, "description": "The name is new"},
            **_errors(403, 408, 413, 415, 422),
        },
        openapi_extra=_body({_SQLITE: _BYTES, _OCTETS: _BYTES}),
    )
    async def upload_set(name: _Name, request: Request) -> SetOut:
        """Put the file of a set here, in place of what had its name, in one step."""
        deadline = at.deadline
        _kind(request, _SQLITE, _OCTETS)
        data = await _read(request, at.options, deadline)
        kept, is_new = await at.desk.do(
            lambda shelf, _: shelf.put(name, data), deadline, is_question=False
        )
        answer = _shown(kept).model_dump()
        return JSONResponse(answer, 201 if is_new else 200)  # type: ignore[return-value]

    @app.post(
        "/sets/{name}/references",
        tags=["sets"],
        status_code=201,
        dependencies=at.writing,
        responses=_errors(403, 404, 408, 413, 415, 422, 503),
        openapi_extra=_body({_JSON: _REFERENCES_SCHEMA}),
    )
    async def add_references(name: _Name, request: Request) -> AddedOut:
        """Add references, all or none; they are on disk when this is answered."""
        deadline = at.deadline
        _kind(request, _JSON)
        given = _parsed(_REFERENCES, await _read(request, at.options, deadline)).references
        if len(given) > at.options.most_scans:
            raise HTTPException(413, f"more than {at.options.most_scans} references at once")
        places = [each.place() for each in given]
        identifiers, version = await at.desk.do(
            lambda shelf, until: _add(shelf, name, places, until), deadline, is_question=False
        )
        return AddedOut(version=version, identifiers=identifiers)


def _locate_scans(app: FastAPI, at: _Counter) -> None:
    """One scan, many scans, one scan among all sets."""

    @app.post(
        "/sets/{name}/locate",
        tags=["locate"],
        dependencies=at.reading,
        responses=_errors(404, 408, 413, 415, 422, 503),
        openapi_extra=_body({_JSON: _SCAN_SCHEMA, BINARY: _BYTES}),
    )
    async def locate(name: _Name, request: Request) -> LocatedOut:
        """Say where one scan was taken."""
        deadline = at.deadline
        (scan,) = await _scans(request, at.options, deadline, 1)
        version, answers = await at.desk.do(partial(_locate, name, [scan], at.options), deadline)
        at.metrics.count(answers)
        answer = {"version": version, **answers[0]}
        return _answered(answer)  # type: ignore[return-value]

    @app.post(
        "/sets/{name}/locate-batch",
        tags=["locate"],
        dependencies=at.reading,
        responses=_errors(404, 408, 413, 415, 422, 503),
        openapi_extra=_body({_JSON: _BATCH_SCHEMA, BINARY: _BYTES}),
    )
    async def locate_batch(name: _Name, request: Request) -> BatchOut:
        """Say where each of many scans was taken, in one version of the set."""
        deadline = at.deadline
        scans = await _scans(request, at.options, deadline, at.options.most_scans)
        version, answers = await at.desk.do(partial(_locate, name, scans, at.options), deadline)
        at.metrics.count(answers)
        answer = {"version": version, "answers": answers}
        return _answered(answer)  # type: ignore[return-value]

    @app.post(
        "/which",
        tags=["locate"],
        dependencies=at.reading,
        responses=_errors(408, 413, 415, 422, 503),
        openapi_extra=_body({_JSON: _SCAN_SCHEMA, BINARY: _BYTES}),
    )
    async def which(request: Request) -> WhichOut:
        """Say in which of all sets, and where in it, one scan was taken."""
        deadline = at.deadline
        (scan,) = await _scans(request, at.options, deadline, 1)
        answer = await at.desk.do(partial(_which, scan), deadline)
        at.metrics.count([answer])
        return _answered(answer)  # type: ignore[return-value]


# The work of the thread that has the sets


def _locate(
    name: str, scans: Sequence[LaserScan], options: ServiceOptions, shelf: Shelf, deadline: float
) -> tuple[str, list[dict[str, Any]]]:
    kept = shelf.take(name)
    answers = []
    for scan in scans:
        if time.monotonic() > deadline:
            raise _too_slow(options)
        start = time.perf_counter()
        found = kept.places.locate(scan)
        answers.append(
            {
                **state_values(found),
                "seconds": time.perf_counter() - start,
                "hypotheses": [hypothesis_values(each) for each in found],
            }
        )
    return kept.version, answers


def _which(scan: LaserScan, shelf: Shelf, _: float) -> dict[str, Any]:
    fleet, versions = shelf.fleet()
    start = time.perf_counter()
    found = fleet.locate(scan)
    return {
        **state_values([each.hypothesis for each in found]),
        "seconds": time.perf_counter() - start,
        "sets": len(fleet),
        "hypotheses": [_named(each, versions) for each in found],
    }


def _named(found: BuildingHypothesis, versions: dict[str, str]) -> dict[str, Any]:
    name = found.building
    return {"building": name, "version": versions[name], **hypothesis_values(found.hypothesis)}


def _add(
    shelf: Shelf, name: str, places: Sequence[Place], deadline: float
) -> tuple[list[int], str]:
    if time.monotonic() > deadline:  # nobody waits for it any more, and it was told so
        raise HTTPException(503, "not done in time", {"Retry-After": "1"})
    return shelf.add(name, places)


def _list(shelf: Shelf, _: float) -> SetsOut:
    shown, unreadable = [], {}
    for name in shelf.names():
        try:
            shown.append(_shown(shelf.take(name)))
        except AnchorscanError as error:
            unreadable[name] = _line(error)
    return SetsOut(sets=shown, unreadable=unreadable)


def _shown(kept: Kept) -> SetOut:
    places, path = kept.places.references, kept.places.path
    assert path is not None
    return SetOut(
        name=kept.name,
        version=kept.version,
        references=len(places),
        with_pose=sum(each.pose is not None for each in places),
        bytes=path.stat().st_size if path.exists() else None,
    )


# Requests


def _kind(request: Request, *allowed: str) -> str:
    """Return the media type of a request, which a page in a browser cannot send unasked."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind not in allowed:
        raise HTTPException(415, f"the content type must be {' or '.join(allowed)}")
    return kind


async def _read(request: Request, options: ServiceOptions, deadline: float) -> bytes:
    """Return the body of a request, if it is neither too large nor too slow."""
    parts, size = [], 0

    async def read() -> None:
        nonlocal size
        async for part in request.stream():
            size += len(part)
            if size > options.largest_request:
                raise _too_large(options)
            parts.append(part)

    try:
        await asyncio.wait_for(read(), max(deadline - time.monotonic(), 0.001))
    except asyncio.TimeoutError:
        raise HTTPException(408, f"the request took more than {options.seconds:g} s") from None
    return b"".join(parts)


def _too_large(options: ServiceOptions) -> HTTPException:
    return HTTPException(413, f"a request has at most {options.largest_request} bytes")


async def _scans(
    request: Request, options: ServiceOptions, deadline: float, most: int
) -> list[LaserScan]:
    """Return the scans of a request, in either form."""
    kind = _kind(request, _JSON, BINARY)
    data = await _read(request, options, deadline)
    if kind == BINARY:
        return unpacked(data, most)
    if most == 1:
        return [_parsed(_SCAN, data).scan()]
    batch = _parsed(_BATCH, data).scans
    if len(batch) > most:
        raise HTTPException(413, f"more than {most} scans at once")
    return [each.scan() for each in batch]


def _answered(values: dict[str, Any]) -> Response:
    """Write an answer as JSON, no digit rounded, in a tenth of the time that JSONResponse takes."""
    return Response(to_json(values, inf_nan_mode="null"), media_type=_JSON)


def _parsed(adapter: TypeAdapter[Result], data: bytes) -> Result:
    try:
        return adapter.validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ScanError(f"{where}: {first['msg']}" if where else str(first["msg"])) from None


def _allow(
    tokens: Sequence[Token], given: HTTPAuthorizationCredentials | None, *, to_write: bool
) -> None:
    """Let pass who has a right; every token is compared, in a time that tells nothing."""
    if not tokens:
        return
    secret = b"" if given is None else given.credentials.encode("utf-8", "surrogateescape")
    is_known = may_write = False
    for token in tokens:
        same = hmac.compare_digest(token.secret.encode(), secret)
        is_known |= same
        may_write |= same and token.may_write
    if not is_known:
        raise HTTPException(401, "a token is needed", {"WWW-Authenticate": "Bearer"})
    if to_write and not may_write:
        raise HTTPException(403, "this token may only read")


def _handle_errors(app: FastAPI, folder: Path) -> None:
    """Answer every error with one line, which does not say where the sets lie."""

    def line(error: Exception) -> str:
        return _line(error).replace(f"{folder}{os.sep}", "")

    async def refused(_: Request, error: Exception) -> Response:
        assert isinstance(error, AnyHTTPException)
        return JSONResponse({"error": str(error.detail)}, error.status_code, error.headers)

    async def malformed(_: Request, error: Exception) -> Response:
        assert isinstance(error, RequestValidationError)
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        return JSONResponse({"error": f"{where}: {first['msg']}"}, 422)

    async def unknown(_: Request, error: Exception) -> Response:
        return JSONResponse({"error": line(error)}, 404)

    async def known(_: Request, error: Exception) -> Response:
        return JSONResponse({"error": line(error)}, 422)

    async def mistake(request: Request, error: Exception) -> Response:
        _LOG.error("%s %s", request.method, request.url.path, exc_info=error)
        return JSONResponse({"error": "a mistake of the service; it has been logged"}, 500)

    app.add_exception_handler(AnyHTTPException, refused)
    app.add_exception_handler(RequestValidationError, malformed)
    app.add_exception_handler(UnknownSetError, unknown)
    app.add_exception_handler(AnchorscanError, known)
    app.add_exception_handler(Exception, mistake)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


class _Gate:
    """Before all else: the host, the size that is announced; after all else: the metrics."""

    def __init__(self, app: Any, options: ServiceOptions, metrics: _Metrics) -> None:
        self._app, self._options, self._metrics = app, options, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status = time.perf_counter(), 500

        async def told(message: MutableMapping[str, Any]) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        refusal = self._refusal(scope)
        try:
            if refusal is not None:
                await refusal(scope, receive, told)
            else:
                await self._app(scope, receive, told)
        finally:
            route = getattr(scope.get("route"), "path", "none")
            self._metrics.request(scope["method"], route, status, time.perf_counter() - start)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = dict(scope["headers"])
        host = headers.get(b"host", b"").decode("latin-1").lower()
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdecimal() else host
        if not self._options.tokens and name.strip("[]") not in _LOOPBACK:
            return JSONResponse({"error": "without tokens only this machine is answered"}, 400)
        size = headers.get(b"content-length", b"0")
        if size.isdigit() and int(size) > self._options.largest_request:
            error = _too_large(self._options)
            return JSONResponse({"error": error.detail}, 413, {"Connection": "close"})
        return None


class _Metrics:
    """What Prometheus is told; of all workers, where there are several."""

    def __init__(self) -> None:
        self._is_shared = _METRICS_FOLDER in os.environ
        registry = self._registry = CollectorRegistry()
        self._requests = Counter(
            "anchorscan_requests",
            "Requests answered.",
            ("method", "route", "status"),
            registry=registry,
        )
        self._seconds = Histogram(
            "anchorscan_request_seconds",
            "Time from a request's head to the end of its answer.",
            ("route",),
            buckets=(0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30),
            registry=registry,
        )
        self._scans = Counter(
            "anchorscan_scans", "Scans located, by outcome.", ("outcome",), registry=registry
        )

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        method = method if method in _METHODS else "other"
        self._requests.labels(method, route, status).inc()
        self._seconds.labels(route).observe(seconds)

    def count(self, answers: Sequence[dict[str, Any]]) -> None:
        for answer in answers:
            outcome = _OUTCOMES.get(answer["state"], answer["state"])
            self._scans.labels(outcome if answer["hypotheses"] else "unusable").inc()

    def text(self) -> bytes:
        if not self._is_shared:
            return bytes(generate_latest(self._registry))
        registry = CollectorRegistry()
        multiprocess.MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
        return bytes(generate_latest(registry))


_METHODS = {"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"}


# The description


def _errors(*codes: int) -> dict[int | str, dict[str, Any]]:
    return {code: {"model": ErrorOut, "description": _REASONS[code]} for code in codes}


_REASONS = {
    400: "Not a request for this service",
    401: "A token is needed",
    403: "The token may only read",
    404: "There is no such set",
    408: "The request came too slowly",
    413: "The request is too large",
    415: "Another content type is needed",
    422: "What was sent makes no sense; the error says why",
    503: "Too much to do; come back later",
}


def _inlined(model: type[BaseModel]) -> dict[str, Any]:
    """Return the JSON schema of a model, without references to other parts of the document."""
    schema = model.model_json_schema()
    parts = schema.pop("$defs", {})

    def resolve(value: Any) -> Any:
        if isinstance(value, dict):
            if "$ref" in value:
                return resolve(parts[value["$ref"].rpartition("/")[2]])
            return {key: resolve(inner) for key, inner in value.items()}
        return [resolve(inner) for inner in value] if isinstance(value, list) else value

    resolved: dict[str, Any] = resolve(schema)
    return resolved


_BYTES = {"type": "string", "format": "binary"}
_SCAN_SCHEMA = _inlined(ScanIn)
_BATCH_SCHEMA = _inlined(BatchIn)
_REFERENCES_SCHEMA = _inlined(ReferencesIn)


def _body(kinds: dict[str, dict[str, Any]]) -> dict[str, Any]:
    content = {kind: {"schema": schema} for kind, schema in kinds.items()}
    return {"requestBody": {"required": True, "content": content}}


def _page(app: FastAPI) -> str:
    """Return a page with every call; it loads nothing, from here or from other sites."""
    schema = app.openapi()
    rows = []
    for path, calls in schema["paths"].items():
        for method, call in calls.items():
            kinds = ", ".join(call.get("requestBody", {}).get("content", {})) or "nothing"
            told = "".join(
                f"<li>{code}: {html.escape(answer.get('description', ''))}</li>"
                for code, answer in sorted(call["responses"].items())
            )
            rows.append(
                f"<h2><code>{method.upper()} {html.escape(path)}</code></h2>"
                f"<p>{html.escape(call.get('description', call['summary']))}</p>"
                f"<p>Takes {html.escape(kinds)}.</p><ul>{told}</ul>"
            )
    title = f"{schema['info']['title']} {schema['info']['version']}"
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title>"
        "<style>body{font:16px/1.5 sans-serif;max-width:50em;margin:2em auto;padding:0 1em}"
        "h2{border-top:1px solid #ccc;padding-top:1em}</style>"
        f"<h1>{title}</h1><p>{html.escape(schema['info']['summary'])} The whole description, "
        "for programs: <a href=openapi.json>openapi.json</a>.</p>" + "".join(rows)
    )
