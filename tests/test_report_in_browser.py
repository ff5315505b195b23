"""The report in Chromium: nothing is loaded or logged, scenes turn, overlays lie on their photos."""

import pathlib
import re

import numpy as np
import pytest
from chromium_page import opened, picture, settled
from report_page import write_every_section, write_photos


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    return write_every_section(tmp_path_factory.mktemp("out") / "report.html", write_photos(tmp_path_factory.mktemp("photos")))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.full)])
def test_page_in_chromium(chromium: str, report_file: pathlib.Path, scheme: str) -> None:
    with opened(chromium, report_file, scheme) as (page, messages, requests):
        scene = page.locator(".plot", has=page.locator("canvas"))
        scene.scroll_into_view_if_needed()
        before = settled(page, scene)
        background = before[-3, -3]
        assert (background.mean() > 128) == (scheme == "light")
        drawn = np.abs(before.astype(int) - background).max(2) > 24
        assert drawn.mean() > 0.01 and len(np.unique(before.reshape(-1, 3), axis=0)) > 100
        box = scene.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 160, y + 40, steps=8)
        page.mouse.up()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] - 5)
        after = settled(page, scene)
        changed = np.abs(after.astype(int) - before.astype(int)).max(2) > 24
        assert changed.mean() > 0.01, "dragging must turn the scene"
        assert page.evaluate("[...document.querySelectorAll('.plot')].every(p => p.querySelector('svg.main-svg'))")
        widths = page.evaluate("Promise.all([...document.images].map(i => i.decode().then(() => i.naturalWidth)))")
        assert widths == [1600, 400]
        buttons = page.locator(".modebar-btn").evaluate_all("all => all.map(b => b.getAttribute('data-title'))")
        assert "Download plot as a PNG" in buttons and not [b for b in buttons if re.search("share|cloud|edit", b, re.I)]
        page.set_viewport_size({"width": 420, "height": 800})
        # Plots follow the window a moment later; then nothing may stick out of a narrow page.
        page.wait_for_function("document.documentElement.scrollWidth <= innerWidth", timeout=30_000)
    assert messages == []
    assert requests and all(address.startswith(("file:", "data:", "blob:")) for address in requests)
    assert [a for a in requests if a.startswith("file:")] == [report_file.as_uri()]


@pytest.mark.slow
def test_a_phone_shows_the_whole_scene(chromium: str, report_file: pathlib.Path) -> None:
    """The ends of its lines, by the matrices that plotly draws them with."""
    projected = (
        "plot => { const { model, view, projection } = plot._fullLayout.scene._scene.glplot.cameraParams;"
        " const times = (m, p) => [0, 1, 2, 3].map(r => [0, 1, 2, 3].reduce((sum, c) => sum + m[4 * c + r] * p[c], 0));"
        " const scale = plot._fullLayout.scene._scene.dataScale;"
        " return plot.data.flatMap(trace => trace.x.map((x, i) => [x, trace.y[i], trace.z[i]]))"
        ".filter(at => at.every(c => c !== null)).map(at => {"
        " const seen = times(projection, times(view, times(model, [...at.map((c, k) => c * scale[k]), 1])));"
        " return [seen[0] / seen[3], seen[1] / seen[3]]; }); }"
    )
    with opened(chromium, report_file, "light", width=390) as (page, messages, _):
        scene = page.locator(".plot", has=page.locator("canvas"))
        settled(page, scene)
        places = np.array(scene.evaluate(projected))
    assert messages == [] and len(places) > 10
    assert np.abs(places).max() < 1.0


@pytest.mark.slow
def test_overlay_lies_on_its_photo(chromium: str, report_file: pathlib.Path) -> None:
    """The disc drawn by OpenCV in the photo and the observed point at its centre coincide on the screen, small and enlarged."""
    with opened(chromium, report_file, "light") as (page, messages, _):
        frame = page.locator(".frame").first
        checked = 0
        for _ in range(2):
            page.locator(".show-observed").uncheck()
            page.locator(".show-model").uncheck()
            frame.scroll_into_view_if_needed()
            bright = picture(frame)[:, :, 0] > 140
            bright[[0, -1]] = bright[:, [0, -1]] = False  # the page beside a frame that starts between two pixels
            rows, columns = np.nonzero(bright)
            disc = np.array([columns.mean(), rows.mean()]) + 0.5
            box = frame.bounding_box()
            point, left, top, width, height = frame.evaluate(
                """frame => {
                    const point = new DOMPoint(2310, 405).matrixTransform(frame.querySelector("svg").getScreenCTM());
                    const photo = frame.querySelector("img").getBoundingClientRect();
                    return [[point.x, point.y], photo.x, photo.y, photo.width, photo.height];
                }"""
            )
            assert box is not None
            # The centre of pixel (u, v) lies at (u + 0.5, v + 0.5) from the corner of the photo, which is 3203 x 2001.
            np.testing.assert_allclose(point, [left + 2310.5 / 3203 * width, top + 405.5 / 2001 * height], atol=1e-2)
            # Chromium paints an image on whole pixels and an overlay between them; screenshots start at a whole pixel.
            np.testing.assert_allclose(disc, [point[0] - np.floor(box["x"]), point[1] - np.floor(box["y"])], atol=0.75)
            page.locator(".show-observed").check()
            shown = picture(frame)
            yellow = (shown[:, :, 2] > 200) & (shown[:, :, 0] < 120)
            centre = np.argwhere(yellow).mean(0)[::-1] + 0.5
            np.testing.assert_allclose(centre, disc, atol=0.75)
            checked += 1
            frame.click()
        assert checked == 2 and frame.get_attribute("aria-expanded") == "false"
    assert messages == []
