"""The page in a real browser, with a run behind it: a click injects a fault, a slider changes the event rate."""

import json
import re
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

import pytest

from tests.emulator.live_page.browser import CHROMIUM, Browser

pytestmark = [
    pytest.mark.system,
    pytest.mark.chromium,
    pytest.mark.socket,
    pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed"),
]

_RIG = """
title = "A board told over a serial line"
[scene]
kind = "checkerboard"
square_px = 40.0
speed_px_s = 12.0
direction_deg = 30.0
bright = 1.0
dark = 0.25
[camera]
model = "davis346"
[run]
step_us = 2000
seed = 1
pace = "{pace}"
[[links]]
kind = "serial"
port = "pty"
baud = 3000000
profile = "ccsds-cobs"
[links.instrument]
when_full = "drop_oldest"
queue_ms = 100.0
"""


@contextmanager
def _run(folder, pace="realtime"):
    """Start a run with a page; yield the page's address, and a place for the run's summary."""
    rig, summary = folder / "board.toml", {}
    rig.write_text(_RIG.format(pace=pace))
    command = [sys.executable, "-m", "evstim", "run", str(rig), "--serve", "--json", "--seconds", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            said = ""
            while "live page: " not in said:
                said = process.stderr.readline()
                assert said, "the run has ended"
            yield re.search(r"http://\S+", said).group(), summary
        finally:
            process.terminate()
            out, _ = process.communicate(timeout=300)
        summary.update(json.loads(out.splitlines()[-1]))


@pytest.fixture(scope="module")
def folder():
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        yield Path(name)


def _rate(browser):
    """Return events per second of stream, of two seconds that begin now."""
    counts = """(() => {
        const digits = document.querySelector('#ledger .head').textContent.replaceAll(/[^\\d]/g, '');
        return [Number(digits), parseFloat(document.querySelector('dd[data-name="stream time"]').textContent)];
    })()"""
    n0, t0 = browser.value(counts)
    browser.until(f"({counts})[1] > {t0 + 2}")
    n1, t1 = browser.value(counts)
    return (n1 - n0) / (t1 - t0)


def _settled(browser, expression):
    """Return the value of an expression when it has not changed for two seconds; pictures may be on their way yet."""
    since_s, value = time.monotonic(), browser.value(expression)
    while time.monotonic() < since_s + 2.0:
        time.sleep(0.1)
        if (now := browser.value(expression)) != value:
            since_s, value = time.monotonic(), now
    return value


def _press_space_until(browser, state):
    """Press the space bar until the page shows a state; a page that connects anew, on a busy machine, sends nothing."""
    shown, until_s = f"document.querySelector('#state').textContent === '{state}'", time.monotonic() + 120
    while not browser.value(shown):
        assert time.monotonic() < until_s, browser.value("document.querySelector('#state').textContent")
        browser.press(" ", "Space", 32)
        pressed_s = time.monotonic()
        while time.monotonic() < pressed_s + 5 and not browser.value(shown):
            time.sleep(0.05)


def _numbers_and_attach_command(browser):
    """Check rates and latency; attach a reader with the command of the page."""
    text = "document.querySelector('dd[data-name=\"{}\"]').parentElement.textContent".format
    browser.until(f"/^event rate\\d.*\\/s since the start$/.test({text('event rate')})")
    assert browser.value(text("latency")) == "latencynoneno event has left a link"
    browser.value("navigator.clipboard.writeText = async text => { window.clipboardText = text; }")
    browser.click(".attach button")
    browser.until("document.querySelector('.attach button').textContent === 'copied'")
    command = browser.value("window.clipboardText")
    port = re.fullmatch(r"evstim listen serial (/dev/\S+) --baud 3000000", command)[1]
    with open(port, "rb"):
        browser.until("document.querySelector('.attach').hidden")
        browser.until(f"/^latency\\d.*99 %: .*, since the start$/.test({text('latency')})")
    browser.until("!document.querySelector('.attach').hidden")


def _history_after_a_reload(browser):
    points = "import('/page.js').then(page => page.axis.points.map(point => point.t_s))"
    browser.until("parseFloat(document.querySelector('dd[data-name=\"stream time\"]').textContent) > 6")
    browser.call("Page.reload")
    browser.until("document.querySelectorAll('#ledger .head').length === 2")
    times = browser.value(points)
    assert times[0] < 1
    assert times[-1] > 6  # a status has the last two seconds alone
    browser.click("input[name=span][value=Infinity]")
    assert browser.value("import('/page.js').then(page => page.axis.from)") == 0


@pytest.mark.long
def test_a_click_injects_a_fault_and_a_slider_changes_the_rate(folder, tmp_path):
    with _run(folder) as (url, summary), Browser(folder / "profile") as browser:
        browser.open(url)
        browser.until("document.querySelector('#state')?.textContent === 'live'")
        browser.until("document.querySelectorAll('#ledger .head').length === 2")
        assert browser.value("document.querySelector('#ledger .head').dataset.sound") == "true"

        now, health = browser.value(
            "['now', 'health'].map(id => document.getElementById(id)).map(e => [e.className, e.textContent])"
        )
        assert re.fullmatch({"good": "now: in time", "late": r"now: \d+ of \d+ steps late"}[now[0]], now[1])
        assert health[1].startswith({"good": "since the start: good", "bad": "since the start: bad: "}[health[0]])
        _numbers_and_attach_command(browser)
        _history_after_a_reload(browser)

        browser.until("document.querySelector('#fault-serial-text').textContent.startsWith('Single inverted bits')")
        browser.value("document.querySelector('#faults [data-key=for_s]').value = '1000'")
        browser.value("document.querySelector('#faults [data-key=count]').value = '0'")
        browser.click("#inject-serial")
        browser.until("document.querySelector('#answer').textContent === 'bit_flips on serial'")
        browser.until("document.querySelector('#links').textContent.includes('1 faults')")
        browser.until("document.querySelector('#changes .what')?.textContent === 'bit flips on serial: active'")
        browser.click("#changes button")
        browser.until("document.querySelector('#changes').textContent.includes('bit flips on serial: over')")
        browser.click("#fault-serial-unplugged")  # apart, and confirmed: cancelled by the Escape key
        browser.until("document.querySelector('dialog')?.open")
        browser.press("Escape", "Escape", 27)
        browser.until("!document.querySelector('dialog')")
        assert browser.value("document.activeElement.id") == "fault-serial-unplugged"
        browser.click("#trigger")
        browser.until("document.querySelector('#links').textContent.includes('1 triggers')")

        before = _rate(browser)
        for name in ("threshold_on", "threshold_off"):
            browser.click(f"#slider-{name}", 0.3)
        for name in ("threshold_on", "threshold_off"):
            browser.until(f"parseFloat(document.querySelector('#row-{name} output').textContent) < 0.12")
        after = _rate(browser)
        assert after > 2.5 * before  # an edge, ln 4 = 1.39, is about 5 events with 0.28 and 13 with 0.1

        colours = browser.value(
            "(c => {const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let on = 0, off = 0;"
            "for (let i = 0; i < d.length; i += 4) {on += d[i] > 180 && d[i+2] < 60; off += d[i+2] > 140 && d[i] < 60;}"
            "return [on, off, c.width, c.height];})(document.querySelector('#picture'))"
        )
        assert colours[2:] == [346, 260]
        assert min(colours[:2]) > 50
        browser.screenshot(tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 20_000
        browser.resize(390, 844, phone=True)
        assert browser.value("document.documentElement.scrollWidth") <= 390
        assert browser.errors == []
    assert summary["balanced"]
    (fault,) = summary["links"]["serial"]["faults"]
    assert (fault["kind"], fault["ended_us"] - fault["began_us"] < 900e6) == ("bit_flips", True)
    assert [change["what"] for change in summary["changes"]][:2] == ["fault bit_flips", "end of fault bit_flips"]
    assert summary["links"]["serial"]["edges"]["taken"] == 1


_THEMES = ("light", "dark")


def _violations(browser):
    """Return the rules of axe-core that the page breaks, with the elements."""
    browser.value(files("axe_core_python").joinpath("axe.min.js").read_text() + ";0")
    found = "axe.run().then(r => r.violations.map(v => [v.id, v.nodes.map(n => n.target.join())]))"
    return browser.value(found)


def _levels(browser):
    """Return the 5th and the 95th percentile of the light's levels on the screen."""
    return browser.value(
        "(c => {const all = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "const d = all.filter((_, i) => i % 4 === 0).sort();"
        "return [0.05, 0.95].map(p => d[Math.round(p * d.length)]);})(document.querySelector('#light-picture'))"
    )


def _screen(level):
    return 255 * (1.055 * min(level, 1) ** (1 / 2.4) - 0.055)


def test_the_picture_is_largest_bright_readable_and_accessible(folder):
    pytest.importorskip("axe_core_python", reason="the accessibility rules are not installed")
    with _run(folder) as (url, _), Browser(folder / "third") as browser:
        browser.open(url)
        browser.until("window.lastPictureUs > 0 && document.querySelectorAll('#ledger .head').length === 2")
        for theme in _THEMES:
            browser.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
            assert browser.value("getComputedStyle(document.body).colorScheme") == theme
            assert _violations(browser) == []
        for width, height in ((390, 844), (2560, 1300), (1280, 900)):
            browser.resize(width, height)
            beside = browser.value("""(() => {
                const time = document.querySelector('#time').getBoundingClientRect(), middle = time.x + time.width / 2;
                const inColumn = [...document.querySelectorAll('section')].map(e => e.getBoundingClientRect())
                    .filter(box => box.x < middle && middle < box.right);
                const main = document.querySelector('main').clientHeight;
                return inColumn.reduce((sum, box) => sum + box.height, 0) / main;
            })()""")
            assert beside > 0.6  # of the column with the time axis is in use
            for view in ("both", "light", "overlay"):
                browser.value(f"document.querySelector('input[value={view}]').click()")
                assert browser.value("document.documentElement.scrollWidth") <= width
        area = "(e => e.getBoundingClientRect().width * e.getBoundingClientRect().height)"
        panes = browser.value(f"{area}(document.querySelector('#panes'))")
        others = browser.value(f"[...document.querySelectorAll('section:not(#show)')].map({area})")
        assert panes > max(others)

        browser.press("v", "KeyV", 86)
        browser.press("v", "KeyV", 86)
        assert browser.value("document.querySelector('input[name=view]:checked').value") == "light"
        browser.until("document.querySelector('#white').textContent")
        assert _levels(browser) == pytest.approx([_screen(0.85 * 0.25), _screen(0.85)], abs=6)
        for _ in range(2):
            browser.press("b", "KeyB", 66)
        assert browser.value("document.querySelector('#stops-text').textContent") == "+1.0 stops"
        assert _levels(browser) == pytest.approx([_screen(2 * 0.85 * 0.25), 255], abs=6)

        browser.value("document.querySelector('#screen').focus()")
        browser.press("ArrowRight", "ArrowRight", 39)
        browser.press("+", "Equal", 187)
        assert browser.value("document.querySelector('#zoom-text').textContent") == "2\u00d7"
        assert browser.value("document.querySelector('#read-pixel').textContent") == "174, 130"
        assert 0.24 < float(browser.value("document.querySelector('#read-light').textContent")) < 1.01
        browser.until("/^ON 0\\.\\d+, OFF 0\\.\\d+$/.test(document.querySelector('#read-thresholds').textContent)")
        browser.press("ArrowRight", "ArrowRight", 39)
        browser.press("ArrowLeft", "ArrowLeft", 37)
        browser.until("document.querySelector('#spoken').textContent.startsWith('pixel 174, 130; light ')")
        browser.value("import('/picture.js').then(m => [10, 50].forEach(n => m.take(new ArrayBuffer(n))))")
        assert browser.value("document.querySelector('#drawn').textContent") == "2 damaged messages left out"
        assert browser.errors == []


@pytest.mark.long
def test_a_run_that_is_not_paced_can_be_paused_and_stepped_from_the_keyboard(folder):
    with _run(folder, "free") as (url, summary), Browser(folder / "other") as browser:
        browser.open(url)
        browser.until("document.querySelector('#pause') && !document.querySelector('#pause').hidden")
        _press_space_until(browser, "paused")
        clock = "document.querySelector('#drawn').ownerDocument.defaultView.lastPictureUs"
        held = _settled(browser, clock)
        browser.press(".", "Period", 190)
        browser.until(f"{clock} === {held} + 2000")
        _press_space_until(browser, "live")
        browser.until(f"{clock} > {held} + 100000")
        browser.click("#again-go")  # with seed 2
        browser.until("document.querySelector('#compare td')?.textContent === '1'")
        browser.until("document.querySelector('#again-why').textContent === 'This run has seed 2.'")
        browser.until("document.querySelector('#state').textContent === 'live'")
        assert browser.value("document.querySelector('#compare').tBodies[0].rows[0].textContent") == "seed12"
        # Between the two runs nobody listens, and the page tries again.
        assert [error for error in browser.errors if "ERR_CONNECTION_REFUSED" not in str(error)] == []
    assert summary["balanced"]
