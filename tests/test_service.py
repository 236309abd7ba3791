"""The service, over loopback with real clients: same answers, one version, nothing lost."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import hypothesis
import numpy as np
import pytest

pytest.importorskip("fastapi", reason="the service is an extra")
uvicorn = pytest.importorskip("uvicorn", reason="the service is an extra")
pytest.importorskip("prometheus_client", reason="the service is an extra")

from as_a_user import run

from anchorscan import (
    Hypothesis,
    LaserScan,
    Pose2D,
    Record,
    ReferenceSet,
    RemoteSet,
    ScanError,
    ServiceError,
    SettingsError,
    drive,
    random_building,
)
from anchorscan.scan_message import BINARY, packed, scan_values
from anchorscan.service import (
    _BATCH,
    ServiceOptions,
    Token,
    _parsed,
    application,
    read_tokens,
)
from anchorscan.set_file import SetFile

READ, WRITE = "read-0123456789abcdef", "write-0123456789abcdef"
TOKENS = (Token(READ, False), Token(WRITE, True))
LARGEST = 2_000_000


@pytest.fixture(scope="module")
def drives() -> tuple[list[Record], list[Record]]:
    building = random_building(11, length=24.0, depth=14.0)
    return drive(building, seed=11, length=25.0), drive(building, seed=11, length=8.0)[8:20]


@pytest.fixture(scope="module")
def scans(drives: tuple[list[Record], list[Record]]) -> list[LaserScan]:
    return [record.scan for record in drives[1] if record.scan is not None][:12]


@pytest.fixture
def folder(tmp_path: Path, drives: tuple[list[Record], list[Record]]) -> Path:
    kept = tmp_path / "sets"
    kept.mkdir()
    ReferenceSet.build(drives[0], path=kept / "office.apr").close()
    return kept


@contextmanager
def serving(folder: Path, **options: Any) -> Iterator[str]:
    """Serve in a thread of this process."""
    port = free_port()
    app = application(ServiceOptions(folder, **options))
    config = uvicorn.Config(app, port=port, log_level="error", access_log=False)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    wait_until(lambda: server.started)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = True
        thread.join()


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


def wait_until(is_done: Any, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not is_done():
        assert time.monotonic() < end, "it took too long"
        time.sleep(0.05)


def ask(
    url: str, method: str, path: str, body: bytes | str = b"", **headers: str
) -> tuple[int, Any]:
    host = url.removeprefix("http://")
    connection = HTTPConnection(host, timeout=60)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, given)
    response = connection.getresponse()
    data = response.read()
    connection.close()
    is_json = "json" in (response.getheader("content-type") or "")
    return response.status, json.loads(data) if is_json else data.decode()


def facts(found: list[Hypothesis]) -> list[Any]:
    return [
        (
            each.reference,
            each.pose,
            each.pose_in_reference,
            each.covariance.tolist(),
            each.evaluation,
            each.quality,
            each.score,
            each.probability,
            each.accepted,
        )
        for each in found
    ]


def test_the_client_answers_to_the_last_bit_as_the_set_in_process(
    folder: Path, scans: list[LaserScan]
) -> None:
    local = ReferenceSet.open(folder / "office.apr")
    expected = [facts(local.locate(scan)) for scan in scans]
    assert any(answer and answer[0][-1] for answer in expected)
    with serving(folder) as url, RemoteSet(url, "office") as remote:
        assert [facts(remote.locate(scan)) for scan in scans] == expected
        assert [facts(found) for found in remote.locate_batch(scans)] == expected
        assert remote.locate_batch([]) == []
        # JSON, too
        for scan, answer in zip(scans[:3], expected, strict=False):
            body = json.dumps(scan_values(scan))
            status, found = ask(
                url, "POST", "/sets/office/locate", body, content_type="application/json"
            )
            assert status == 200
            assert found["hypotheses"][0]["probability"] == answer[0][7]
            assert found["version"] == remote.version


def test_a_reference_that_was_added_is_on_disk_and_in_the_next_answer(
    folder: Path, scans: list[LaserScan]
) -> None:
    with serving(folder) as url, RemoteSet(url, "office") as remote:
        remote.locate(scans[0])
        before = remote.version
        added = remote.add(scans[0], Pose2D(1.0, 2.0, 3.0), "here")
        on_disk = ReferenceSet.open(folder / "office.apr")
        assert on_disk[added].pose == Pose2D(1.0, 2.0, 3.0)
        assert on_disk[added].name == "here"
        assert remote.version != before
        after = remote.version
        remote.locate(scans[0])
        assert remote.version == after
        # What another process writes is seen as well.
        on_disk.add(scans[1], Pose2D())
        remote.locate(scans[0])
        assert remote.version != after
        with pytest.raises(ServiceError, match="must be finite"):
            remote.add(scans[0], Pose2D(np.nan, 0.0, 0.0))
        with pytest.raises(ServiceError, match="do not go together"):
            remote.add_batch(scans[:2], [None])


def test_a_set_replaced_while_it_is_asked_gives_no_mixed_answer(
    folder: Path, drives: tuple[list[Record], list[Record]], scans: list[LaserScan], tmp_path: Path
) -> None:
    """Each of two sets answers with references of its own alone, and with its own version."""
    moved = ReferenceSet(path=tmp_path / "moved.apr")
    for record in drives[0][:40]:
        assert record.scan is not None
        assert record.pose is not None
        moved.add(record.scan, Pose2D(1000.0, 0.0, 0.0) @ record.pose)
    moved.close()
    files = [(folder / "office.apr").read_bytes(), (tmp_path / "moved.apr").read_bytes()]
    seen: dict[str, set[bool]] = {}
    stop = threading.Event()
    problems: list[Exception] = []

    def asking(url: str) -> None:
        with RemoteSet(url, "office") as remote:
            while not stop.is_set():
                try:
                    for found in remote.locate_batch(scans):
                        is_far = {each.pose.x > 500.0 for each in found if each.pose is not None}
                        seen.setdefault(remote.version, set()).update(is_far)
                except ServiceError as error:
                    problems.append(error)

    with serving(folder) as url:
        threads = [threading.Thread(target=asking, args=(url,)) for _ in range(2)]
        for thread in threads:
            thread.start()
        versions = set()
        for turn in range(12):
            status, shown = ask(
                url,
                "PUT",
                "/sets/office",
                files[turn % 2],
                content_type="application/octet-stream",
            )
            assert status == 200, shown
            versions.add(shown["version"])
        stop.set()
        for thread in threads:
            thread.join()
    assert not problems
    assert len(versions) == 2
    assert set(seen) <= versions
    assert all(len(far) == 1 for far in seen.values()), seen


def test_a_reference_that_no_map_can_hold_is_refused_before_it_is_stored(
    folder: Path, scans: list[LaserScan]
) -> None:
    with serving(folder) as url, RemoteSet(url, "office") as office:
        before, count = (
            facts(office.locate(scans[0])),
            len(ReferenceSet.open(folder / "office.apr")),
        )
        with pytest.raises(ServiceError, match="is a pose wrong") as refused:
            office.add(scans[0], Pose2D(1e7, 0.0, 0.0))
        assert str(folder) not in str(refused.value)
        assert facts(office.locate(scans[0])) == before
        assert len(ReferenceSet.open(folder / "office.apr")) == count


def test_a_write_that_has_begun_is_waited_for(
    folder: Path, scans: list[LaserScan], monkeypatch: pytest.MonkeyPatch
) -> None:
    append = SetFile.append

    def slowly(*values: Any, **named: Any) -> Any:
        time.sleep(1.0)
        return append(*values, **named)

    monkeypatch.setattr(SetFile, "append", slowly)
    count = len(ReferenceSet.open(folder / "office.apr"))
    with serving(folder, seconds=0.5) as url, RemoteSet(url, "office") as office:
        assert office.add(scans[0], Pose2D()) == count  # not told that it was not done
    assert len(ReferenceSet.open(folder / "office.apr")) == count + 1


def test_a_request_in_which_all_is_wrong_costs_no_more_than_its_size(folder: Path) -> None:
    ranges = '","'.join(["x"] * 15_000)
    scan = f'{{"angle_min":0,"angle_increment":0.0001,"ranges":["{ranges}"]}}'
    body = f'{{"scans":[{",".join([scan] * 12)}]}}'
    tracemalloc.start()
    try:
        with pytest.raises(ScanError, match="ranges"):
            _parsed(_BATCH, body.encode())
        assert tracemalloc.get_traced_memory()[1] < 4 * len(body)
    finally:
        tracemalloc.stop()


def test_tokens_decide_who_may_do_what(folder: Path, scans: list[LaserScan]) -> None:
    with serving(folder, tokens=TOKENS) as url:
        assert ask(url, "GET", "/health")[0] == 200
        for path in ("/sets", "/sets/office", "/metrics"):
            assert ask(url, "GET", path)[0] == 401
            assert ask(url, "GET", path, authorization="Bearer nonsense")[0] == 401
            assert ask(url, "GET", path, authorization=f"Bearer {READ}")[0] == 200
        with pytest.raises(ServiceError, match="token is needed"):
            RemoteSet(url, "office").locate(scans[0])
        reader, writer = (RemoteSet(url, "office", token=token) for token in (READ, WRITE))
        assert reader.locate(scans[0])
        with pytest.raises(ServiceError, match="may only read"):
            reader.add(scans[0])
        assert writer.locate(scans[0])
        assert writer.add(scans[0], Pose2D()) > 0
        status, _ = ask(
            url,
            "PUT",
            "/sets/new",
            b"x",
            content_type="application/octet-stream",
            authorization=f"Bearer {READ}",
        )
        assert status == 403


def test_without_tokens_only_this_machine_is_answered(folder: Path) -> None:
    with serving(folder) as url:
        assert ask(url, "GET", "/sets", host="localhost")[0] == 200
        status, answer = ask(url, "GET", "/sets", host="evil.example")
        assert (status, answer) == (400, {"error": "without tokens only this machine is answered"})
    done = run("serve", folder, "--host", "0.0.0.0")
    assert done.code == 1
    assert "without tokens" in done.err
    assert run("serve", folder / "none").code == 1


def test_a_file_of_tokens_is_read_and_its_secrets_are_never_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "tokens"
    file.write_text(f"# ours\nread {READ}\n\nwrite {WRITE}\n")
    assert read_tokens(file) == TOKENS
    assert READ not in repr(read_tokens(file))
    monkeypatch.setenv("ANCHORSCAN_TOKENS", f"write {WRITE}")
    assert read_tokens(None) == TOKENS[1:]
    for text in ("read short", f"admin {READ}", f"{READ}", ""):
        file.write_text(text)
        with pytest.raises(SettingsError) as told:
            read_tokens(file)
        assert READ not in str(told.value)


BAD = [
    ("POST", "/sets/office/locate", b"{", "application/json", 422),
    ("POST", "/sets/office/locate", b"\xff\xfe", "application/json", 422),
    ("POST", "/sets/office/locate", b"[]", "application/json", 422),
    ("POST", "/sets/office/locate", b"{}", "text/plain", 415),
    ("POST", "/sets/office/locate", b"{}", "", 415),
    ("POST", "/sets/office/locate", b"nonsense", BINARY, 422),
    ("POST", "/sets/office/locate", b"", BINARY, 422),
    ("POST", "/sets/office/locate-batch", b'{"scans": []}', "application/json", 422),
    ("POST", "/sets/office/locate-batch", b'{"scans": {}}', "application/json", 422),
    ("POST", "/sets/no/locate", packed([LaserScan(np.ones(9), 0, 0.1)]), BINARY, 404),
    ("POST", "/sets/..%2Foffice/locate", b"{}", "application/json", 404),
    ("POST", "/sets/.office/locate", b"{}", "application/json", 422),
    ("POST", "/sets/office/references", b'{"references": [1]}', "application/json", 422),
    ("PUT", "/sets/office", b"no set", "application/octet-stream", 422),
    ("PUT", "/sets/office", b"", "application/octet-stream", 422),
    ("PUT", "/sets/office", b"x" * (LARGEST + 1), "application/octet-stream", 413),
    ("GET", "/nothing", b"", "", 404),
    ("DELETE", "/sets/office", b"", "", 405),
]


def test_bad_requests_are_answered_with_one_clear_line(
    folder: Path, scans: list[LaserScan]
) -> None:
    before = (folder / "office.apr").read_bytes()
    body = scan_values(scans[0])
    changes: list[dict[str, Any]] = [
        {"angle_increment": 0.0},
        {"angle_increment": 1e400},
        {"angle_min": "0"},
        {"ranges": "far"},
        {"ranges": ["far"]},
        {"ranges": [[1.0]]},
        {"ranges": [1.0] * 20_001},
        {"range_min": 5.0, "range_max": 1.0},
        {"angle_minimum": 1.0},
    ]
    bad = [
        ("POST", "/sets/office/locate", json.dumps(body | change).encode(), "application/json", 422)
        for change in changes
    ]
    with serving(folder, largest_request=LARGEST, most_scans=3) as url:
        for method, path, data, kind, expected in [*BAD, *bad]:
            status, answer = ask(url, method, path, data, content_type=kind)
            assert status == expected, (method, path, data[:50], answer)
            assert list(answer) == ["error"]
            assert "\n" not in answer["error"]
            assert len(answer["error"]) > 5
        with pytest.raises(ServiceError, match="between 1 and 3"):
            RemoteSet(url, "office").locate_batch(scans[:4])
        blank = LaserScan(np.full(90, np.inf, np.float32), 0.0, 0.01)
        assert RemoteSet(url, "office").locate(blank) == []
        assert ask(url, "GET", "/health")[0] == 200
    assert (folder / "office.apr").read_bytes() == before
    assert [path.name for path in folder.iterdir()] == ["office.apr"]


def test_a_request_that_comes_too_slowly_is_ended(folder: Path) -> None:
    with serving(folder, seconds=0.5) as url:
        host, port = url.removeprefix("http://").split(":")
        with socket.create_connection((host, int(port)), timeout=30) as slow:
            slow.sendall(
                b"POST /sets/office/locate HTTP/1.1\r\nHost: localhost\r\n"
                b"Content-Type: application/json\r\nContent-Length: 1000\r\n\r\n{"
            )
            assert slow.recv(100).startswith(b"HTTP/1.1 408")


def test_no_other_origin_is_let_in_and_metrics_count(folder: Path, scans: list[LaserScan]) -> None:
    with serving(folder) as url:
        RemoteSet(url, "office").locate_batch(scans)
        connection = HTTPConnection(url.removeprefix("http://"))
        connection.request(
            "OPTIONS",
            "/sets/office/locate",
            headers={"Origin": "http://x", "Access-Control-Request-Method": "POST"},
        )
        response = connection.getresponse()
        assert response.status == 405
        assert not [name for name, _ in response.getheaders() if "access-control" in name.lower()]
        connection.close()
        text = ask(url, "GET", "/metrics")[1]
        told = re.findall(r'^anchorscan_scans_total\{outcome="[a-z ]+"\} ([0-9.]+)$', text, re.M)
        assert sum(map(float, told)) == len(scans)
        page = ask(url, "GET", "/docs")[1]
        assert "/sets/{name}/locate" in page
        assert "src=" not in page  # nothing is loaded from other sites


def test_which_set_is_told_over_all_sets(folder: Path, scans: list[LaserScan]) -> None:
    other = drive(random_building(9, length=24.0, depth=14.0), seed=1, length=15.0)
    ReferenceSet.build(other, path=folder / "other.apr").close()
    with serving(folder) as url:
        answers = [ask(url, "POST", "/which", packed([s]), content_type=BINARY) for s in scans]
        listed = ask(url, "GET", "/sets")[1]["sets"]
        versions = {each["name"]: each["version"] for each in listed}
    assert all(status == 200 and answer["sets"] == 2 for status, answer in answers)
    best = [answer["hypotheses"][0] for _, answer in answers if answer["accepted"]]
    assert best
    assert {each["building"] for each in best} == {"office"}
    assert {each["version"] for each in best} == {versions["office"]}


@pytest.mark.parametrize(
    ("url", "token"),
    [
        ("http://[::1", None),
        ("http://a..b:9", None),
        ("ftp://a", None),
        ("http://127.0.0.1:9", "t\u00f6ken"),
        ("http://127.0.0.1:9", "two\nlines"),
    ],
)
def test_an_address_or_a_token_that_can_be_none_is_refused(url: str, token: str | None) -> None:
    with pytest.raises(ServiceError):
        RemoteSet(url, "office", token=token)


@pytest.mark.parametrize(
    "answer",
    [
        {"answers": []},
        {"hypotheses": [{"reference": 1e999}]},
        {"identifiers": ["a"]},
        {"identifiers": [None]},
        {"identifiers": []},
        {"identifiers": [0, 1]},
        [],
    ],
)
def test_an_answer_of_another_kind_is_an_error_in_one_line(
    answer: Any, scans: list[LaserScan], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = json.dumps(answer).encode()
    monkeypatch.setattr(RemoteSet, "_send", lambda *_, **__: (200, data))
    office = RemoteSet("http://127.0.0.1:9", "office", token=f"{READ}\n")
    for call in (office.locate, lambda scan: office.locate_batch([scan]), office.add):
        with pytest.raises(ServiceError, match=r"another kind|asked for|as a service"):
            call(scans[0])
    monkeypatch.setattr(RemoteSet, "_send", lambda *_, **__: (200, b"[" * 100_000))
    with pytest.raises(ServiceError, match="as a service"):
        office.locate(scans[0])


def test_a_client_without_a_service_says_so(scans: list[LaserScan]) -> None:
    with pytest.raises(ServiceError, match="localhost"):
        RemoteSet(f"http://localhost:{free_port()}", "office").locate(scans[0])
    for url in ("office.apr", "ftp://host", "http://host:port"):
        with pytest.raises(ServiceError, match="not the address"):
            RemoteSet(url, "office")


def test_the_service_keeps_to_its_own_description(folder: Path) -> None:
    schemathesis = pytest.importorskip("schemathesis", reason="for developers")
    from schemathesis.specs.openapi.checks import positive_data_acceptance

    @schemathesis.serializer(BINARY, "application/vnd.sqlite3")  # type: ignore[misc]
    def as_bytes(_: Any, value: Any) -> bytes:
        return value if isinstance(value, bytes) else str(value).encode()

    rights = {"Authorization": f"Bearer {WRITE}"}
    with serving(folder, largest_request=LARGEST, tokens=TOKENS) as url:
        schema = schemathesis.openapi.from_url(f"{url}/openapi.json")
        operations = [found.ok() for found in schema.get_all_operations()]
        assert len(operations) == 9
        modes = (schemathesis.GenerationMode.POSITIVE, schemathesis.GenerationMode.NEGATIVE)
        for operation, mode in itertools.product(operations, modes):

            @hypothesis.settings(max_examples=10, database=None, derandomize=True)
            @hypothesis.given(operation.as_strategy(generation_mode=mode))
            def check(case: Any) -> None:
                # A scan can fit the description and still be none: limits out of order.
                case.call_and_validate(headers=rights, excluded_checks=[positive_data_acceptance])

            with contextlib.suppress(hypothesis.errors.Unsatisfiable):
                check()  # nothing is wrong with a call that takes nothing


def test_a_worker_killed_under_load_loses_no_accepted_write(
    folder: Path, scans: list[LaserScan]
) -> None:
    port = free_port()
    url = f"http://127.0.0.1:{port}"
    words = ("serve", str(folder), "--port", str(port), "--workers", "2")
    service = subprocess.Popen(
        [sys.executable, "-c", "from anchorscan.cli import main; main()", *words],
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    accepted: list[tuple[int, str]] = []
    stop = threading.Event()

    def is_up() -> bool:
        assert service.poll() is None
        try:
            return ask(url, "GET", "/health")[0] == 200
        except OSError:
            return False

    def adding(number: int) -> None:
        count = 0
        remote = RemoteSet(url, "office", seconds=10.0)
        while not stop.is_set():
            name = f"{number}-{count}"
            count += 1
            try:
                accepted.append((remote.add(scans[count % len(scans)], Pose2D(), name), name))
            except ServiceError:
                time.sleep(0.05)  # the worker is gone: ask the next one

    try:
        wait_until(is_up)
        wait_until(lambda: len(workers_of(service.pid)) == 2)
        threads = [threading.Thread(target=adding, args=(number,)) for number in range(3)]
        for thread in threads:
            thread.start()
        wait_until(lambda: len(accepted) > 10)
        victims = workers_of(service.pid)
        os.kill(victims[0], signal.SIGKILL)
        before = len(accepted)
        wait_until(lambda: len(accepted) > before + 10)
        stop.set()
        for thread in threads:
            thread.join()
    finally:
        stop.set()
        left = workers_of(service.pid)
        service.terminate()
        try:
            service.wait(60)
        finally:
            for process in (service.pid, *left):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
    places = ReferenceSet.open(folder / "office.apr")
    assert len({identifier for identifier, _ in accepted}) == len(accepted)
    assert all(places[identifier].name == name for identifier, name in accepted)


def workers_of(parent: int) -> list[int]:
    """Name the worker processes, by what Linux tells."""
    if not sys.platform.startswith("linux"):
        pytest.skip("asks Linux for its processes")
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                words = (folder / "cmdline").read_bytes()
                status = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(status[1]) == parent and b"spawn_main" in words and status[0] != "Z":
                found.append(int(folder.name))
    return sorted(found)
