"""The report as a person meets it: in a real browser, from disk, with clicks and keys."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from report_pages import NASTY, answer, located, of, record, reference, square_scan

from anchorscan import Pose2D, Record, Reference
from anchorscan.answers import Guess, Run, ScanAnswer
from anchorscan.report import write_report

selenium = pytest.importorskip("selenium", reason="the browser is driven by selenium")
from selenium import webdriver  # noqa: E402 - only where selenium is there
from selenium.webdriver.common.action_chains import ActionChains  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import Select, WebDriverWait  # noqa: E402

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
DRIVER = shutil.which("chromedriver")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None or DRIVER is None:
        pytest.skip("no headless browser here (Debian: apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for switch in ("--headless=new", "--disable-gpu", "--window-size=1400,1300"):
        options.add_argument(switch)
    if os.geteuid() == 0:  # Chromium's sandbox refuses root, which containers run as
        options.add_argument("--no-sandbox")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    yield driver
    driver.quit()


class Shown:
    """A page that is open in the browser."""

    def __init__(self, browser: Any) -> None:
        self.browser = browser

    def run(self, script: str) -> Any:
        return self.browser.execute_script(script)

    def text(self, name: str) -> str:
        return str(self.browser.find_element(By.ID, name).text)

    def click(self, name: str) -> None:
        self.browser.find_element(By.ID, name).click()

    def press(self, *keys: str) -> None:
        for key in keys:
            self.browser.find_element(By.TAG_NAME, "body").send_keys(key)

    def scan(self) -> int:
        """Number of the scan that is shown."""
        return int(self.text("verdict").split(":")[0].removeprefix("Scan "))

    def select(self, name: str, value: str) -> None:
        Select(self.browser.find_element(By.ID, name)).select_by_value(value)

    def colours(self, name: str, least: int = 10) -> set[tuple[int, ...]]:
        """Colours that a canvas shows on more than so many pixels."""
        counts = self.run(
            f"const c = document.getElementById('{name}');"
            # A copy: reading back from a canvas that is drawn on makes Chromium complain.
            "const copy = new OffscreenCanvas(c.width, c.height)"
            "  .getContext('2d', {willReadFrequently: true});"
            "copy.drawImage(c, 0, 0);"
            "const d = copy.getImageData(0, 0, c.width, c.height).data, counts = {};"
            "for (let i = 0; i < d.length; i += 4) {"
            "  const key = [d[i], d[i + 1], d[i + 2]].join();"
            "  if (d[i + 3] > 250) counts[key] = (counts[key] || 0) + 1;"
            "} return counts;"
        )
        return {tuple(map(int, key.split(","))) for key, count in counts.items() if count > least}

    def complaints(self) -> list[str]:
        return [entry["message"] for entry in self.browser.get_log("browser")]


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Iterator[Callable[..., Shown]]:
    """Write a report, open it from disk, and see that the browser has no complaint at the end."""

    def write_and_open(*arguments: Any, address: str = "", **words: Any) -> Shown:
        path = tmp_path / "report.html"
        write_report(path, *arguments, **words)
        browser.get("about:blank")
        browser.get(path.as_uri() + address)
        return Shown(browser)

    yield write_and_open
    assert Shown(browser).complaints() == []


RIGHT, WRONG, SCAN, REFERENCE = (0, 114, 178), (213, 94, 0), (0, 114, 178), (230, 159, 0)


@pytest.fixture
def office() -> tuple[list[Run], list[Reference], Any]:
    """Six queries: two wrong, one silent, one unusable, and further hypotheses."""
    second = Guess(Pose2D(4.0, 0.0, 0.5), 0.05, 2)
    third = Guess(Pose2D(0.0, 1.0, 0.0), 0.01, 1)
    answers = [
        answer(0, 0.1, 0.99, more=(second, third)),
        answer(1, 4.0, 0.97),
        answer(2, 2.1, 0.4, accepted=False),
        answer(3, 3.1, 0.95),
        answer(4, 0.0, 0.92),
        ScanAnswer(5, False, (), 5.0, 0.001, "no reading is a return"),
    ]
    logs = of(*(record(n, float(n)) for n in range(6)))
    return [located(*answers)], [reference(1), reference(2, 4.0, 1.5)], logs


def test_it_opens_on_the_worst_case_and_loads_nothing(
    show: Callable[..., Shown], office: Any
) -> None:
    page = show(*office, title="office")
    assert page.browser.title == "office"
    assert page.scan() == 1
    assert "located, wrong" in page.text("verdict")
    assert page.text("position") == "1 of 6"
    assert page.run("return performance.getEntriesByType('resource').length") == 0


def test_keys_and_buttons_step_through_queries(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office)
    seen = [page.scan()]
    for _ in range(5):
        page.press(Keys.ARROW_RIGHT)
        seen.append(page.scan())
    assert sorted(seen) == [0, 1, 2, 3, 4, 5]
    page.press(Keys.ARROW_RIGHT)
    assert page.scan() == seen[-1]  # the last stays the last
    page.click("previous")
    assert page.scan() == seen[-2]
    page.click("next")
    assert page.scan() == seen[-1]
    page.press(Keys.HOME)
    assert page.scan() == seen[0]
    page.press(Keys.ARROW_LEFT)
    assert page.scan() == seen[0]
    page.press(Keys.END)
    assert page.scan() == seen[-1]


def test_an_ambiguous_scan_says_how_many_places_are_alike(
    show: Callable[..., Shown], office: Any
) -> None:
    _, references, logs = office
    twin = Guess(Pose2D(9.0, 0.0, 0.0), 0.45, reference=2, ambiguous=True)
    unsure = answer(2, 2.1, 0.5, accepted=False, more=(twin, Guess(Pose2D(), 0.01, 1)))
    first = replace(unsure.guesses[0], ambiguous=True)
    unsure = replace(unsure, guesses=(first, *unsure.guesses[1:]))
    page = show([located(unsure)], references, logs, address="#run=0&scan=2")
    assert page.text("verdict").endswith("; ambiguous: 2 places explain it alike")


def test_an_unusable_scan_says_why(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office, address="#run=0&scan=5")
    assert page.text("verdict") == "Scan 5: unusable scan"
    assert "no reading is a return" in page.text("facts")
    assert page.text("hypotheses") == ""


def test_hypotheses_are_chosen_by_key_and_by_click(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office, address="#run=0&scan=0")

    def chosen() -> list[str]:
        rows = page.browser.find_elements(By.CSS_SELECTOR, "#hypotheses tr.chosen td")
        return [cell.text for cell in rows]

    assert chosen()[:6] == ["1", "1", "0.10", "0.00", "0.0°", "0.990"]
    assert chosen()[-1] == "0.10 m, 0.0°"
    page.press(Keys.ARROW_DOWN)
    assert chosen()[:5] == ["2", "2", "4.00", "0.00", "28.6°"]
    page.press(Keys.ARROW_DOWN, Keys.ARROW_DOWN)
    assert chosen()[0] == "3"
    page.press(Keys.ARROW_UP)
    assert chosen()[0] == "2"
    page.browser.find_elements(By.CSS_SELECTOR, "#hypotheses tbody tr")[0].click()
    assert chosen()[0] == "1"


def test_a_click_on_the_map_chooses_the_query_there(
    show: Callable[..., Shown], office: Any
) -> None:
    page = show(*office)
    for scan in (2, 4, 0):
        x, y = page.run(
            "const c = document.getElementById('map');"
            f"const p = run().queries.find((q) => q.scan === {scan}).truth;"
            "return [(p[0] - state.view.x) * state.view.scale,"
            "        -(p[1] - state.view.y) * state.view.scale];"
        )
        canvas = page.browser.find_element(By.ID, "map")
        ActionChains(page.browser).move_to_element_with_offset(
            canvas, round(x), round(y)
        ).click().perform()
        assert page.scan() == scan


def test_the_map_moves_and_zooms_and_comes_back(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office)
    canvas = page.browser.find_element(By.ID, "map")
    before = page.run("return state.view")
    ActionChains(page.browser).drag_and_drop_by_offset(canvas, 60, 30).perform()
    moved = page.run("return state.view")
    assert (moved["x"] - before["x"]) * before["scale"] == pytest.approx(-60, abs=2)
    assert (moved["y"] - before["y"]) * before["scale"] == pytest.approx(30, abs=2)
    page.run(
        "document.getElementById('map').dispatchEvent(new WheelEvent('wheel', {deltaY: -300}))"
    )
    assert page.run("return state.view.scale") > 1.3 * before["scale"]
    ActionChains(page.browser).double_click(canvas).perform()
    after = page.run("return state.view")
    assert {k: pytest.approx(v) for k, v in before.items()} == after


def test_the_scan_is_drawn_over_reference_and_map(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office, address="#run=0&scan=0")
    # More than the marks of the two sensors: the readings of both scans.
    assert {SCAN, REFERENCE} <= page.colours("overlay", 700)
    assert {RIGHT, WRONG} <= page.colours("map")
    page.click("show-reference")
    # Without the reference scan the overlay has lost its colour.
    assert REFERENCE not in page.colours("overlay")
    before = page.run("return document.getElementById('overlay').toDataURL()")
    page.press("t")
    assert page.browser.find_element(By.ID, "at-truth").is_selected()
    assert page.run("return document.getElementById('overlay').toDataURL()") != before


def test_filters_and_orders_choose_the_list(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office)
    page.select("filter", "wrong")
    assert page.text("position") == "1 of 2"
    cells = page.browser.find_elements(By.CSS_SELECTOR, "#cases tbody tr td:first-child")
    assert [cell.text for cell in cells] == ["1", "4"]
    page.select("filter", "all")
    page.select("order", "log")
    cells = page.browser.find_elements(By.CSS_SELECTOR, "#cases tbody tr td:first-child")
    assert [cell.text for cell in cells] == ["0", "1", "2", "3", "4", "5"]
    page.browser.find_elements(By.CSS_SELECTOR, "#cases tbody tr")[3].click()
    assert page.scan() == 3


def test_another_threshold_changes_what_is_located(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office)
    assert page.text("recall").count("2 right, 2 wrong, 1 not known") == 1
    page.run(
        "const t = document.getElementById('threshold'); t.value = 0.98;"
        "t.dispatchEvent(new Event('input'))"
    )
    assert "1 right, 0 wrong, 4 not known" in page.text("recall")
    assert "located, right: 1" in page.text("legend")
    assert page.scan() == 1
    assert "not known" in page.text("verdict")
    page.click("as-decided")
    assert "2 right, 2 wrong, 1 not known" in page.text("recall")
    svg = page.browser.find_element(By.CSS_SELECTOR, "#recall svg")
    ActionChains(page.browser).move_to_element_with_offset(
        svg, -round(0.35 * svg.size["width"]), 0
    ).click().perform()
    assert page.run("return state.threshold") == 0.99


def test_hostile_text_is_shown_and_does_nothing(show: Callable[..., Shown]) -> None:
    runs = [
        Run("locate", NASTY, (ScanAnswer(0, False, (), None, 0.1, NASTY),)),
        Run("locate", "two", (ScanAnswer(0, False, (), None, 0.1, "none"),)),
    ]
    page = show(runs, title=NASTY, notes=[NASTY])
    assert page.run("return document.images.length") == 0
    assert page.run("return document.scripts.length") == 2
    assert page.browser.title != "owned"
    assert "<img src=x onerror=alert(1)>" in page.text("facts")
    assert "<img src=x onerror=alert(1)>" in page.text("notes")


def test_one_can_change_between_runs(show: Callable[..., Shown]) -> None:
    logs = {"a": lambda: iter([record(0)]), "b": lambda: iter([record(0, 3.0)])}
    runs = [
        Run("bench", "first", (answer(0),), "a"),
        Run("bench", "second", (answer(0), answer(1)), "b"),
    ]
    page = show(runs, [], logs)
    assert page.text("position") == "1 of 1"
    page.select("run", "1")
    assert page.text("position") == "1 of 2"
    assert "located, wrong" in page.text("verdict")


def test_a_set_without_poses_shows_scan_over_reference(show: Callable[..., Shown]) -> None:
    guess = Guess(None, 0.9, reference=1, pose_in_reference=Pose2D(0.5, 0.0, 0.1))
    runs = [located(ScanAnswer(0, True, (guess,)))]
    page = show(runs, [Reference(1, square_scan())], of(record(0, posed=False)))
    assert not page.browser.find_element(By.ID, "map-panel").is_displayed()
    assert {SCAN, REFERENCE} <= page.colours("overlay", 700)
    assert page.text("verdict") == "Scan 0: located"


def test_dark_is_dark(show: Callable[..., Shown], office: Any) -> None:
    page = show(*office)

    def brightness() -> float:
        colour = page.run("return getComputedStyle(document.body).backgroundColor")
        return sum(map(int, colour.removeprefix("rgb(").removesuffix(")").split(","))) / 3.0

    light = brightness()
    scheme = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
    page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", scheme)
    try:
        assert light > 200.0
        assert brightness() < 60.0
        # The canvases follow a little later: the scan is drawn in the colour of the dark theme.
        WebDriverWait(page.browser, 30.0).until(lambda _: (86, 180, 233) in page.colours("overlay"))
    finally:
        page.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


def test_a_thousand_queries_open_quickly_enough_to_use(show: Callable[..., Shown]) -> None:
    answers = [answer(n, n % 7 / 3.0) for n in range(1000)]
    records = [
        Record(n, square_scan(2.0 + 0.001 * n), Pose2D(math.sin(n), math.cos(n), 0.0))
        for n in range(1000)
    ]
    page = show([located(*answers)], [reference(1)], of(*records))
    assert page.text("position") == "1 of 1000"
    page.press(*[Keys.ARROW_RIGHT] * 5)
    assert page.text("position") == "6 of 1000"
