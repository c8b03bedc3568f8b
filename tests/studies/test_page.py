"""A report in a real browser, without a network: what is seen, sorted, toggled and shown under the pointer."""

import os
import shutil

import pytest
from made import MadeRecords
from playwright.sync_api import sync_playwright

from csac.studies.named import NAMED
from csac.studies.report import write_report

pytestmark = pytest.mark.slow

NAMES = ("chromium", "chromium-browser", "chromium-headless-shell", "google-chrome", "google-chrome-stable")
HEIGHTS = {"csac": 6_000, "sac": 5_000, "td3": 4_000, "sd3": 3_000, "ppo": 1_000}


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Three studies of which everything is known, among them bars, panels and swept weights."""
    studies = [
        study.narrowed(tasks=study.tasks[:1])
        for name in ("mujoco", "efficiency", "robustness")
        for study in NAMED[name]
    ]
    source = MadeRecords(lambda cell, step: (HEIGHTS[cell.algorithm] + 10 * cell.seed) * step / cell.steps)
    return write_report(
        [*studies, *NAMED["ablation"]], source, tmp_path_factory.mktemp("report"), ["csac study run it"]
    )


@pytest.fixture(scope="module")
def browser():
    path = next(filter(None, map(shutil.which, NAMES)), None)
    if path is None and os.environ.get("CSAC_REQUIRE_BROWSER"):
        pytest.fail("no chromium is installed, and CSAC_REQUIRE_BROWSER asks for one")
    if path is None:
        pytest.skip("no chromium is installed (apt-get install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, report):
    """A function that opens the report; afterwards, that nothing was fetched and nothing was complained of."""
    fetched, complaints, contexts = [], [], []

    def opening(**options):
        context = browser.new_context(offline=True, **options)
        contexts.append(context)
        page = context.new_page()
        page.on("request", lambda request: fetched.append(request.url))
        page.on(
            "console", lambda message: complaints.append(message.text) if message.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(report.as_uri())
        return page

    yield opening
    for context in contexts:
        context.close()
    assert [url for url in fetched if not url.startswith("data:")] == [report.as_uri()] * len(contexts)
    assert complaints == []


def column(page, table, index):
    return table.locator(f"tbody tr.plain td:nth-child({index})").all_inner_texts()


def drawn(page, title):
    """The figure of this title, once plotly has drawn it."""
    figure = page.locator("figure", has=page.locator("figcaption strong", has_text=title)).first
    figure.scroll_into_view_if_needed()
    figure.locator(".plot.drawn .main-svg").first.wait_for()
    return figure


def test_a_click_on_a_heading_sorts_the_table(opened):
    page = opened()
    table = page.locator("table", has=page.locator("caption", has_text="HalfCheetah-v4")).first
    assert table.locator("th").all_inner_texts() == ["method", "the paper", "measured", "at step", "seeds"]
    before = column(page, table, 3)
    assert before[0] == "6,020 ± 16"
    table.locator("th", has_text="measured").get_by_role("button").click()
    assert column(page, table, 3) == sorted(before, key=lambda text: float(text.split()[0].replace(",", "")))
    assert column(page, table, 1)[0] == "PPO"
    table.locator("th", has_text="measured").get_by_role("button").click()
    assert column(page, table, 1)[-1] == "PPO"
    table.locator("th", has_text="the paper").get_by_role("button").click()
    assert column(page, table, 2)[:2] == ["4,181.89 ± 723.54", "7,158.19 ± 2,821.74"]
    assert column(page, table, 1)[-1] == "CSAC (periodic)"  # of which the paper has nothing: last, either way round
    table.locator("th", has_text="the paper").get_by_role("button").click()
    assert column(page, table, 1)[-1] == "CSAC (periodic)"


def test_the_legend_toggles_a_curve_with_its_band(opened):
    page = opened()
    figure = drawn(page, "HalfCheetah-v4")
    lines, bands = figure.locator(".scatterlayer .js-line"), figure.locator(".scatterlayer .js-fill")
    (there, filled) = (lines.count(), bands.count())
    figure.locator(".legendtoggle").first.click()
    page.wait_for_function("() => document.querySelector('figure .legend .traces').style.opacity === '0.5'")
    assert lines.count() < there
    assert bands.count() < filled
    figure.locator(".legendtoggle").first.click()
    page.wait_for_function("() => document.querySelector('figure .legend .traces').style.opacity === '1'")
    assert (lines.count(), bands.count()) == (there, filled)


def test_values_are_shown_under_the_pointer(opened):
    page = opened()
    figure = drawn(page, "HalfCheetah-v4")
    box = figure.locator(".nsewdrag").first.bounding_box()
    page.mouse.move(box["x"] + 0.98 * box["width"], box["y"] + box["height"] / 2)
    told = figure.locator(".hoverlayer .legendtext")
    told.first.wait_for()
    texts = told.all_text_contents()
    assert len(texts) == 6
    # A seed's return is 6,000, 6,010, ... 6,040 at the end: the mean is 6,020 and the deviation 15.8.
    assert texts[0] == "CSAC (paper) (5 seeds) : 6,020 (± standard deviation: 6,004.2 to 6,035.8)"


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1400, 400])
def test_it_is_seen_in_light_and_dark_wide_and_narrow(opened, tmp_path, scheme, width):
    """Nothing is wider than the window, text stands out from what is behind it, and there is a picture of the whole."""
    page = opened(color_scheme=scheme, viewport={"width": width, "height": 900})
    for title in ("HalfCheetah-v4", "HalfCheetah-v4, friction", "Walker2d-v4, over tau"):
        drawn(page, title)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    text, ground = page.evaluate(
        "[getComputedStyle(document.body).color, getComputedStyle(document.documentElement).backgroundColor]"
    )
    assert (_brightness(text) > _brightness(ground)) == (scheme == "dark")
    assert abs(_brightness(text) - _brightness(ground)) > 150
    page.screenshot(path=tmp_path / "page.png", full_page=True)
    assert (tmp_path / "page.png").stat().st_size > 100_000


def test_the_last_number_of_an_axis_is_shown(opened):
    page = opened(viewport={"width": 400, "height": 900})
    assert drawn(page, "HalfCheetah-v4").locator(".xtick text").all_text_contents()[-1] == "1M"


def test_on_paper_the_still_pictures_stand_in_place_of_the_plots(opened):
    page = opened(color_scheme="dark")
    assert page.locator("figure img").first.is_hidden()
    page.emulate_media(media="print")
    assert page.locator("figure img").first.is_visible()
    assert page.locator(".plots").first.is_hidden()
    assert page.evaluate("getComputedStyle(document.documentElement).backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate("[...document.images].every((image) => image.complete && image.naturalWidth > 500)")


def test_without_scripts_there_are_pictures_and_tables(opened):
    page = opened(java_script_enabled=False)
    assert page.locator("figure img").first.is_visible()
    assert page.locator("table").first.is_visible()


def _brightness(colour):
    return sum(map(int, colour[colour.index("(") + 1 : -1].split(",")[:3])) / 3
