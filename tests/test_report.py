"""The report: nothing loaded, nothing unescaped, everything there; and in a real browser it draws."""

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from implicam.coverage import assess, tercile_labels
from implicam.errors import MissingExtraError, UsageError
from implicam.figures import error_against_sd, reliability, scene
from implicam.formatting import number
from implicam.measurement import Measurement
from implicam.report import ReportData, page, write_report

pytest.importorskip("plotly")
HOSTILE = "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&"


def report_data(*, factor: float = 1.0, truth: bool = True, n: int = 512, name: str = "b", seed: int = 0) -> ReportData:
    """Fabricated: errors drawn from the covariance, which then is stated `factor`² times as large."""
    rng = np.random.default_rng(seed)
    true = rng.uniform(-150, 150, (n, 3)) + np.array([0, 0, 900])
    sd = np.outer(0.05 + 0.0003 * (true[:, 2] - 700), [0.7, 0.7, 1.6])
    cov = np.einsum("ni,ij->nij", sd**2, np.eye(3))
    xyz = true + sd * rng.normal(size=(n, 3))
    missing = np.arange(n) % 57 == 5
    xyz[missing], cov[missing] = np.nan, np.nan
    measured = Measurement(
        points=np.array([f"{name}{i:03d}" for i in range(n)]),
        xyz=xyz,
        cov=cov * factor**2,
        views=rng.integers(2, 7, n),
        consistency=rng.uniform(size=n),
        reason=np.where(missing, f"seen by 1 camera {name}", ""),
        length_unit="mm",
    )
    coverage = assess(xyz - true, measured.cov, regions={"distance": tercile_labels(true[:, 2])}, limit=cov)
    return ReportData(
        title=f"rig {name}",
        subtitle=f"subtitle {name}",
        measurement=measured,
        facts=((f"method {name}", f"forward-gp {name}"),),
        coverage=coverage if truth else None,
        true_xyz=true if truth else None,
        known_xyz=rng.uniform(-150, 150, (157, 3)) + np.array([0, 0, 900]),
        cameras={f"cam {name}": (0.0, 0.0, 0.0)},
        notes=(f"a note {name}",),
    )


class Reader(HTMLParser):
    """Collects what a browser would load, run and show."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.handlers: list[str] = []
        self.ids: set[str] = set()
        self.tags: list[str] = []
        self.content: dict[str, list[str]] = {"script": [], "style": [], "json": [], "text": []}
        self._inside = "text"
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        values = dict(attrs)
        self.loads += [str(values[key]) for key in ("src", "href", "action", "data", "poster") if key in values]
        self.handlers += [key for key in values if key.startswith("on")]
        self.ids |= {str(values["id"])} if "id" in values else set()
        if tag in ("script", "style"):
            self._inside = "json" if values.get("type") == "application/json" else tag

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self._inside = "text"

    def handle_data(self, data: str) -> None:
        self.content[self._inside].append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.content["text"]))


# --------------------------------------------------------------------------------------------------------- the page


def test_page_is_whole_and_loads_nothing(tmp_path: Path):
    write_report(tmp_path / "report.html", report_data())
    file = tmp_path / "report.html"
    assert file.stat().st_size < 10e6
    read = Reader(file.read_text(encoding="utf-8"))
    assert read.loads == []
    assert read.handlers == []
    assert not {"link", "iframe", "object", "embed", "img", "base"} & set(read.tags)
    assert not re.search(r"@import|url\(", " ".join(read.content["style"]))
    assert {"result", "scene", "honesty", "regions", "left-out", "method", "versions"} <= read.ids
    assert {"plot-scene", "plot-reliability", "plot-error-sd"} <= read.ids


def test_page_says_what_was_found():
    data = report_data()
    text = Reader(page(data)).text
    row = data.coverage.overall
    inside = row.level(0.95).ellipsoid
    assert (
        f"off by {number(row.rmse)} mm rms; its 95 % ellipsoid contained the truth for {100 * inside.value:.1f} %"
        in text
    )
    assert "of 503 points" in text
    assert "The error bars tell the truth." in text
    assert "503 of 512" in text
    assert "distance: near" in text
    assert text.count("seen by 1 camera b") == 9
    assert "Cramér–Rao limit" in text
    assert "a note b" in text
    assert "numpy" in text


def test_a_measured_point_with_a_reason_is_not_called_unmeasured():
    data = report_data(n=80)
    m = data.measurement
    why = "measured without cam3, whose view contradicts the others"
    reason = m.reason.astype(object)
    reason[[7, 8]] = why
    data = replace(data, measurement=replace(m, reason=reason.astype(np.str_)))
    assert [name for name, _ in data.unmeasured] == ["b005", "b062"]
    assert data.without_a_view == [("b007", why), ("b008", why)]
    text = Reader(page(data)).text
    assert "78 of 80" in text
    assert "Not measured: 2 " in text
    assert "Measured without a view that contradicts the others: 2 " in text
    assert text.count(why) == 2
    every = replace(
        m, xyz=np.nan_to_num(m.xyz), cov=np.where(np.isfinite(m.cov), m.cov, np.eye(3)), reason=np.full(80, why)
    )
    text = Reader(page(ReportData("rig", every))).text
    assert "Every point was measured." in text
    assert "Not measured" not in text
    assert "others: 80 " in text


@pytest.mark.parametrize(
    ("factor", "words"), [(0.6, "The error bars are too small."), (1.6, "The error bars are too large.")]
)
def test_verdict_in_words(factor: float, words: str):
    assert words in Reader(page(report_data(factor=factor))).text


def test_without_truth_nothing_is_claimed():
    read = Reader(page(report_data(truth=False)))
    assert "The error bars were not checked here." in read.text
    assert "503 points measured, with a typical stated uncertainty of" in read.text
    assert "honesty" not in read.ids
    assert "plot-scene" in read.ids


def test_hostile_names_stay_text():
    html = page(report_data(name=HOSTILE, n=80))
    read, harmless = Reader(html), Reader(page(report_data(n=80)))
    assert read.tags == harmless.tags
    assert read.loads == []
    assert read.handlers == []
    assert HOSTILE in read.text
    for figure in read.content["json"]:
        assert "<" not in figure
        assert "<img" not in str(json.loads(figure))  # Plotly shows entities as text, and tags as tags


def test_plotlys_toolbar_is_no_bar_over_the_figure():
    figures = [json.loads(figure) for figure in Reader(page(report_data(n=40))).content["json"]]
    assert [figure["layout"]["modebar"]["bgcolor"] for figure in figures] == ["rgba(0,0,0,0)"] * 3


def test_same_data_same_page():
    assert page(report_data(n=40)) == page(report_data(n=40))


@pytest.mark.parametrize("keep", [slice(0, 1), slice(0, 2), slice(0, 6), slice(5, 6), slice(0, 0)])
def test_few_or_no_points(keep: slice):
    data = report_data(n=6)
    m = data.measurement
    few = Measurement(
        m.points[keep], m.xyz[keep], m.cov[keep], m.views[keep], m.consistency[keep], m.reason[keep], "mm"
    )
    errors = (m.xyz - data.true_xyz)[keep]
    text = Reader(page(ReportData("few", few, coverage=assess(errors, few.cov), true_xyz=data.true_xyz[keep]))).text
    assert "Too few points to judge" in text
    assert ("No point could be measured." in text) == (not few.measured.any())
    assert "nan" not in text


def test_one_bad_covariance_is_told():
    data = report_data(n=80)
    m = data.measurement
    cov = m.cov.copy()
    cov[3] = np.diag([1.0, -1.0, 1.0])
    bad = Measurement(m.points, m.xyz, cov, m.views, m.consistency, m.reason, "mm")
    text = Reader(
        page(ReportData("bad", bad, coverage=assess(m.xyz - data.true_xyz, cov), true_xyz=data.true_xyz))
    ).text
    assert "the covariance could not be judged: 1" in text
    assert "b003 a standard uncertainty is zero, or its square negative" in text


def test_parts_that_do_not_belong_together_are_refused():
    data = report_data(n=40)
    with pytest.raises(UsageError, match="other points"):
        ReportData("x", report_data(n=30).measurement, coverage=data.coverage)
    with pytest.raises(UsageError, match="true_xyz"):
        ReportData("x", report_data(n=30).measurement, true_xyz=data.true_xyz)


@pytest.mark.parametrize("library", ["plotly.offline", "jinja2"])
def test_without_a_library_the_cure_is_named(library: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(__import__("sys").modules, library, None)
    with pytest.raises(MissingExtraError, match=r"implicam\[report\]"):
        page(report_data(n=40))


# ------------------------------------------------------------------------------------------------------ the figures


def test_scene_draws_each_measured_point_and_its_line():
    data = report_data()
    m = data.measurement
    figure = scene(m.xyz, m.sd, names=m.points, views=m.views, unit="mm", true_xyz=data.true_xyz, error=data.error)
    points = next(trace for trace in figure.data if trace.name.startswith("measured"))
    assert len(points.x) == 503
    assert "error 0." in points.text[0]
    shown = [trace for trace in figure.data if trace.mode == "lines" and trace.visible]
    assert [trace.name for trace in shown] == ["towards the truth, ×100"]
    i = int(np.flatnonzero(m.measured)[7])
    line = np.stack([shown[0].x, shown[0].y, shown[0].z], axis=1)[21:24]
    assert line[0] == pytest.approx(m.xyz[i])
    assert line[1] - line[0] == pytest.approx(100 * (data.true_xyz[i] - m.xyz[i]))
    assert np.isnan(line[2]).all()
    assert figure.layout.scene.aspectmode == "data"


def test_scene_without_truth_is_coloured_by_uncertainty():
    m = report_data().measurement
    figure = scene(m.xyz, m.sd, names=m.points, views=m.views, unit="mm")
    points = figure.data[0]
    assert points.marker.color == pytest.approx(np.linalg.norm(m.sd[m.measured], axis=1))
    assert points.marker.colorbar.title.text == "stated uncertainty<br>(mm)"
    assert not figure.layout.updatemenus


def test_reliability_draws_the_intervals():
    coverage = report_data().coverage
    ellipsoid = next(trace for trace in reliability(coverage).data if trace.name == "3D ellipsoid")
    found = coverage.overall.level(0.95).ellipsoid
    assert ellipsoid.y[3] == pytest.approx(100 * found.value)
    assert ellipsoid.y[3] - ellipsoid.error_y.arrayminus[3] == pytest.approx(100 * found.low)
    assert ellipsoid.y[3] + ellipsoid.error_y.array[3] == pytest.approx(100 * found.high)


def test_error_against_sd_leaves_out_what_a_log_axis_cannot_show():
    figure = error_against_sd(np.array([0.1, 0, np.nan, 2]), np.array([0.1, 1, 1, 0.5]), names=list("abcd"), unit="m")
    assert list(figure.data[0].y) == [0.1, 2]
    assert len(figure.data) == 4
    assert len(error_against_sd(np.zeros(2), np.zeros(2), names=["a", "b"], unit="m").data) == 1


# ------------------------------------------------------------------------------------------------ in a real browser


@pytest.mark.slow
@pytest.mark.browser
def test_page_draws_in_a_browser(tmp_path: Path, chromium: dict[str, Any]):
    sync_api = pytest.importorskip("playwright.sync_api")
    write_report(tmp_path / "report.html", report_data(name="<b onclick=alert(1)>é"))
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(**chromium)
        try:
            view = browser.new_page(viewport={"width": 1400, "height": 1000})
            told, asked = listen(view)
            view.goto((tmp_path / "report.html").as_uri())
            view.wait_for_selector("#plot-scene canvas", timeout=120_000)
            view.wait_for_function("document.querySelectorAll('.js-plotly-plot .main-svg').length >= 3")
            view.locator("#plot-scene").scroll_into_view_if_needed()
            assert view.evaluate("document.querySelectorAll('#plot-error-sd .point').length") == 503
            hovered = hover_somewhere(view)
            assert "<b onclick=alert(1)>é" in hovered
            assert "error 0." in hovered
            assert "sd x 0." in hovered
            with_lines = vermillion_pixels(view)
            view.get_by_text("no errors", exact=True).click()
            view.wait_for_timeout(500)
            assert with_lines > 500
            assert vermillion_pixels(view) < with_lines / 4  # what is left is the scene's own
            assert told == []
            assert asked == [(tmp_path / "report.html").as_uri()]
        finally:
            browser.close()


@pytest.mark.slow
@pytest.mark.browser
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off_on_a_phone(tmp_path: Path, chromium: dict[str, Any], scheme: Any):
    sync_api = pytest.importorskip("playwright.sync_api")
    write_report(tmp_path / "report.html", report_data(name="a-name-" + 90 * "x"))
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(**chromium)
        size = {"width": 390, "height": 844}
        view = browser.new_context(viewport=size, is_mobile=True, has_touch=True, color_scheme=scheme).new_page()
        view.goto((tmp_path / "report.html").as_uri())
        view.wait_for_function("document.querySelectorAll('.js-plotly-plot .main-svg').length >= 3", timeout=120_000)
        beyond = view.evaluate(
            """() => [...document.querySelectorAll("body *")].filter((one) => {
                const box = one.getBoundingClientRect();
                const lines = one.closest("svg, .gl-container") && one.tagName !== "text";  // a figure clips them
                return !lines && box.width && (box.right > 391 || box.left < -1);
            }).map((one) => `${one.tagName} ${one.getAttribute("class")} ${one.textContent.slice(0, 40)}`)"""
        )
        assert beyond == []
        assert view.evaluate("document.documentElement.scrollWidth") == 390
        assert (
            view.evaluate("getComputedStyle(document.querySelector('#regions td + td'), '::before').content")
            == '"points"'
        )
        browser.close()


def listen(view):
    """Errors the page makes, and what it requests, as they come."""
    told: list[str] = []
    asked: list[str] = []
    view.on("console", lambda message: told.append(message.text) if message.type == "error" else None)
    view.on("pageerror", lambda error: told.append(str(error)))
    view.on("dialog", lambda dialog: (told.append(dialog.message), dialog.dismiss()))
    view.on("request", lambda request: asked.append(request.url))
    return told, asked


def hover_somewhere(view) -> str:
    """Move over the middle of the scene until a label shows; its text."""
    box = view.locator("#plot-scene").bounding_box()
    for k in range(80):
        # Golden-ratio steps spread over the middle of the cloud.
        x, y = 0.35 + 0.3 * (k * 0.618 % 1), 0.4 + 0.3 * (k * 0.377 % 1)
        view.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
        view.wait_for_timeout(60)
        labels = view.locator("#plot-scene .hovertext").all_text_contents()
        if labels and "sd x" in labels[0]:
            return labels[0]
    pytest.fail("no label appeared over the 3D scene")


def vermillion_pixels(view) -> int:
    """Pixels of the error lines' colour, counted in a photograph of the WebGL canvas's place."""
    image = pytest.importorskip("matplotlib.image")
    view.mouse.move(5, 5)
    view.wait_for_timeout(200)
    rgb = 255 * image.imread(BytesIO(view.locator("#plot-scene").screenshot()))[..., :3]
    return int((np.abs(rgb - [0xD5, 0x5E, 0x00]).max(axis=-1) < 40).sum())
