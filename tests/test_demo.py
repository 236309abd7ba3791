"""The demonstration: its figures are those of the protocol, its picture is one."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from anchorscan import MissingExtraError
from anchorscan.cli import main
from anchorscan.demo import demonstrate, draw, killian_court, run, table


@pytest.fixture
def recording() -> Path:
    pytest.importorskip("rtbdata", reason="the recording is in the extra 'demo'")
    return killian_court()


def test_the_demo_as_a_user_runs_it(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(sys, "argv", ["anchorscan", "demo", "-o", str(tmp_path / "new")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    words = capsys.readouterr().out.split()
    counts = [int(word) for word in words[words.index("scan") + 1 :][:4]]
    correct, wrong, silent, best = counts
    assert correct + wrong + silent == 807
    # The corridors are twins of each other: it must say so rather than err.
    assert 500 < best < 807
    assert correct > 20
    assert wrong <= 0.02 * (correct + wrong)
    picture = tmp_path / "new" / "killian-court.png"
    assert str(picture) in words
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size < 300_000


def test_queries_are_later_visits_and_the_table_adds_up(recording: Path) -> None:
    outcome = demonstrate(recording, progress=lambda items, what, total=None: list(items)[:20])
    references = set(outcome.split.references)
    assert len(outcome.places) == len(references)
    assert len(outcome.located) == 20
    for each in outcome.located:
        assert each.answer.query not in references
        assert each.answer.truth == each.record.pose
    text = "\n".join(table(outcome))
    assert f"{outcome.figures.correct} " in text
    pytest.importorskip("matplotlib")
    assert draw(outcome).axes


@pytest.mark.parametrize("missing", ["rtbdata", "matplotlib"])
def test_without_its_extra_the_demo_says_what_to_type(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if missing == "matplotlib":
        pytest.importorskip("rtbdata")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(MissingExtraError, match=r"pip install 'anchorscan\[demo\]'"):
        run(tmp_path / "new", None, print, lambda items, what, total=None: items)
    assert not (tmp_path / "new").exists()
