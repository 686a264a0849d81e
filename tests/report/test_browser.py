"""The page in headless Chromium: no error, no request, everything drawn, the switches work."""

import shutil

import pytest

pytest.importorskip("plotly")
pytest.importorskip("jinja2")
pytest.importorskip("websockets")

from estbench.report.html import write_report
from estbench.report.rendering import render
from tests.report.browser import Browser

if shutil.which("chromium") is None and shutil.which("chromium-browser") is None:
    pytest.skip("no Chromium: apt-get install chromium", allow_module_level=True)

READY = "document.body.dataset.state === 'ready'"
DRAWN = """[...document.querySelectorAll('figure:not([hidden]) .plot')].map(p => ({
  id: p.id, width: p.clientWidth, traces: Number(p.dataset.drawn),
  marks: [...p.querySelectorAll('.js-line, .js-fill, .point, .points path')].filter(
    m => (m.getAttribute('d') || '').length > 4).length}))"""


@pytest.fixture(scope="module")
def browser():
    with Browser() as page:
        yield page


@pytest.fixture(scope="module")
def page(store_of_two, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "report.html"
    return f"file://{write_report([store_of_two], path, video=render.available())}"


@pytest.fixture(scope="module")
def store_of_two(tmp_path_factory):
    import estbench

    folder = tmp_path_factory.mktemp("browser") / "two"
    estbench.run("pendulum", ["ekf", "ukf"], runs=8, duration=0.5, out=folder)
    return folder


def open_page(browser, page, width):
    browser.size(width, 900, touch=width < 600)
    browser.open(page)
    browser.wait(READY)


@pytest.mark.parametrize("width", [1280, 390])
def test_everything_is_drawn_without_errors_or_requests(browser, page, width):
    open_page(browser, page, width)
    drawn = browser.ask(DRAWN)
    assert len(drawn) == browser.ask("document.querySelectorAll('.plot').length") >= 16
    assert [d["id"] for d in drawn if not d["traces"] or not d["marks"]] == []
    assert all(0 < d["width"] <= width for d in drawn)
    assert browser.ask("document.documentElement.scrollWidth") <= width  # nothing sticks out
    assert browser.errors == []
    assert browser.requests == [page]
    if render.available():
        assert browser.ask("document.querySelectorAll('video').length") in (0, 2)
        assert browser.ask("document.querySelector('img.robot').naturalWidth") == 480


def test_the_estimator_switch(browser, page):
    open_page(browser, page, 1280)
    traces = "document.getElementById('nees').data.filter(t => t.meta.role).map(t => t.meta.entry)"
    assert browser.ask(traces) == ["ekf", "ukf"]
    browser.ask("document.querySelector('[data-entry=ekf]').click()")
    browser.wait(READY)
    assert browser.ask(traces) == ["ukf"]
    pressed = "document.querySelector('[data-entry=ekf]').getAttribute('aria-pressed')"
    assert browser.ask(pressed) == "false"
    browser.ask("document.querySelector('[data-entry=ekf]').click()")
    browser.wait(READY)
    assert browser.ask(traces) == ["ekf", "ukf"]
    assert browser.errors == []


def test_the_run_switch_by_keyboard(browser, page):
    open_page(browser, page, 1280)
    y = "Array.from(document.getElementById('error-0').data.at(-1).y).slice(0, 5).join()"
    before, run = browser.ask(y), browser.ask("document.getElementById('run').value")
    key = "next" if browser.ask("document.getElementById('run').selectedIndex") == 0 else "previous"
    browser.ask(f"document.getElementById('{key}').focus()")
    for kind in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", text="\r",
                     windowsVirtualKeyCode=13)  # fmt: skip
    browser.wait(f"document.getElementById('run').value !== '{run}'")
    browser.wait(READY)
    assert browser.ask(y) != before
    shown = browser.ask("document.querySelector('.run-number').textContent")
    assert shown == browser.ask("document.getElementById('run').value")


def test_zoom_is_shared_in_time(browser, page):
    open_page(browser, page, 1280)
    browser.ask("Plotly.relayout('nees', {'xaxis.range': [0.1, 0.3]}).then(() => true)")
    browser.wait(READY)
    for name in ("nis", "rmse-1", "error-0", "run-nees"):
        ends = browser.ask(f"document.getElementById('{name}').layout.xaxis.range")
        assert ends == pytest.approx([0.1, 0.3])
    assert browser.ask("[from.value, to.value].map(Number)") == [0.1, 0.3]
    browser.ask("document.getElementById('whole').click()")
    browser.wait(READY)
    assert browser.ask("document.getElementById('nis').layout.xaxis.range") == pytest.approx(
        [0, 0.5]
    )


def test_a_clip_is_played_by_its_button(browser, page):
    open_page(browser, page, 1280)
    if not browser.ask("document.querySelectorAll('video').length"):
        pytest.skip("no clips: nothing can be drawn here")
    button = "document.querySelector('.play')"
    label = f"{button}.getAttribute('aria-label')"
    assert browser.ask(label).startswith("play: The best run")
    browser.ask(f"{button}.click()")
    browser.wait("document.querySelector('video').currentTime > 0")
    assert browser.ask(label).startswith("pause: The best run")
    browser.ask(f"{button}.click()")
    browser.wait("document.querySelector('video').paused")
    assert browser.errors == []


def test_light_and_dark(browser, page):
    open_page(browser, page, 1280)
    colours = []
    for _ in range(2):
        colours.append(browser.ask("document.getElementById('nees').layout.font.color"))
        browser.ask("document.getElementById('theme').click()")
        browser.wait(READY)
    assert len(set(colours)) == 2
    assert browser.errors == []
