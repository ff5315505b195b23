"""A report in the hands of a reader, in Chromium: tables are sorted, notes unfold, lines are picked and hidden, pages printed."""

import pathlib

import cv2
import numpy as np
import pytest
from chromium_page import opened
from report_page import some_lines, some_segments

from omnilines import report
from omnilines.records import Advice, Polyline, Summary, ViewResult

NOTES = tuple(f"Note {k}: something that is to be known." for k in range(5))
VIEWS = [
    ViewResult("view 2", "b.jpg", True, None, 48, 1, 0.31),
    ViewResult("view 10", "a.jpg", True, None, 9, 0, 1.2),
    ViewResult("view 1", "c.jpg", False, "no board was found."),
]


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("report")
    for name in ("wide.jpg", "small.png"):
        cv2.imwrite(str(folder / name), np.full((300, 400, 3), 90, np.uint8))
    across = np.array([[10.0, 100.0], [390.0, 120.0]])
    curves = [Polyline("wide.jpg", across, "track 2", "model"), Polyline("small.png", across, "track 0", "model")]
    sections = [
        report.verdict_section(
            Summary("Result", (), verdict="It is good.", advice=(Advice("Few photos.", "Give `min_views` 3."),))
        ),
        report.summary_section(Summary("Result", (("rms_px_per_axis", "0.30 px"),), NOTES)),
        report.scene_section(lines=some_lines(), groups=["family 1"] * 3 + ["no family"] * 2, segments=some_segments()),
        report.photos_section(folder, curves),
        report.views_section(VIEWS),
    ]
    return report.write_report(folder / "report.html", "A scene", sections)


@pytest.mark.slow
def test_a_reader_sorts_picks_unfolds_and_prints(chromium: str, page_file: pathlib.Path) -> None:
    with opened(chromium, page_file, "dark") as (page, messages, _):
        page.set_viewport_size({"width": 390, "height": 800})
        page.wait_for_function("document.documentElement.scrollWidth <= innerWidth", timeout=30_000)

        assert page.locator("p.verdict").inner_text() == "It is good."
        assert page.locator(".advice tbody td").all_inner_texts() == ["Few photos.", "Give min_views 3."]
        assert page.locator(".advice code").inner_text() == "min_views"
        assert page.locator("text=Note 2:").is_visible() and not page.locator("text=Note 3:").is_visible()
        page.locator("summary", has_text="2 more notes").click()
        assert page.locator("text=Note 4:").is_visible()

        table = page.locator(".scroll table")
        names = "table => [...table.tBodies[0].rows].map(row => row.cells[0].textContent)"
        assert table.evaluate(names) == ["view 2", "view 10", "view 1"]
        table.get_by_role("button", name="View", exact=True).click()
        assert table.evaluate(names) == ["view 1", "view 2", "view 10"]
        by_rms = table.get_by_role("button", name="RMS per point (px)")
        by_rms.click()
        assert table.evaluate(names) == ["view 2", "view 10", "view 1"]
        by_rms.click()
        assert table.evaluate(names) == ["view 10", "view 2", "view 1"], "what is not known is last either way"
        assert table.locator("[aria-sort]").get_attribute("aria-sort") == "descending"

        # A click on the middle of the third line, as plotly tells it.
        page.evaluate(
            """() => {
                const plot = [...document.querySelectorAll(".plot")].find(one => one.layout.meta);
                const data = plot.data[0];
                plot.emit("plotly_click", { points: [{ text: data.text[9], data }] });
            }"""
        )
        said = page.locator(".picked-line")
        known, seen = said.inner_text().split(". Seen in ")
        assert known == "track 2: ok, 7 views, largest sigma across 1.2 mm, residual 0.25 px; family 1"
        assert seen == "2 photos: wide.jpg, broken.jpg"
        assert page.locator("path.picked").evaluate_all("all => all.map(p => p.textContent)") == ["track 2"]
        said.get_by_role("button", name="wide.jpg").click()
        assert page.locator(".photo.large").get_attribute("data-photo") == "wide.jpg"

        drawn = "svg => getComputedStyle(svg).clipPath"
        overlay = page.locator(".frame svg").first
        assert overlay.evaluate(drawn) == "inset(0px 0% 0px 0px)"
        page.locator(".reveal input").fill("25")
        assert overlay.evaluate(drawn) == "inset(0px 75% 0px 0px)"

        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        ink = "getComputedStyle(document.body).color"
        assert page.evaluate(ink) == "rgb(29, 33, 38)", "paper is white"
        assert page.evaluate("document.querySelectorAll('details:not([open])').length") == 0
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        assert page.evaluate(ink) == "rgb(228, 230, 234)"
    assert messages == []
