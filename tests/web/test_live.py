"""The live page of a simulated robot: real processes, real Zenoh, a real browser."""

from __future__ import annotations

import json
import re
import signal
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from adaptive_contact.service.link import Link, client_settings
from adaptive_contact.service.recording import Recording
from adaptive_contact.wire import (
    LearnerStatus,
    learner_key,
)
from programs import Program
from waiting import until

from .chromium import Chromium, Tab, found
from .running import events

pytestmark = pytest.mark.e2e

LEGS = ["lf", "lm", "lr", "rf", "rm", "rr"]


# What the page's modules keep and do, by the names that they give it.
_MODULES = """
Promise.all(['data', 'stream', 'theme', 'plots', 'charts', 'above'].map(
  (name) => import(`/${name}.js`)))
  .then(([data, stream, theme, plots, charts, above]) => {
    Object.assign(globalThis, { ...data, stream, theme, plots, above, panel: charts });
  })
"""


def banner(url: str) -> str:
    """What a browser is given first."""
    return str(events(url, lambda found: "legs" in found)["banner"])


def begun(*words: str) -> Program:
    return Program("-m", "adaptive_contact", *words, start_new_session=True)


class Robot:
    """Service, simulated robot and page."""

    def __init__(self) -> None:
        self.parts: list[Program] = []
        service = self.begin("serve", "--no-state", "--listen", "tcp/127.0.0.1:0")
        # The first start of a revision compiles, which takes long beside other work.
        self.endpoint = service.wait_line(r"listening on (tcp/\S+?)[;,]", 180).group(1)
        self.begin("sim", "walk", "--terrain", "rough", "--connect", self.endpoint)
        self.page = self.begin("watch", "--web", "--no-browser", "--connect", self.endpoint)
        self.url = self.page.wait_line(r"live page at (http://\S+)").group(1)

    def begin(self, *args: str) -> Program:
        part = begun(*args)
        self.parts.append(part)
        return part

    def close(self) -> None:
        for part in reversed(self.parts):
            part.close()


@pytest.fixture(scope="module")
def robot() -> Iterator[Robot]:
    one = Robot()
    yield one
    one.close()


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    if found() is None:
        pytest.skip("no chromium is installed (apt install chromium)")
    with Chromium(tmp_path_factory.mktemp("chromium")) as one:
        yield one


@pytest.fixture
def tab(robot: Robot, browser: Chromium) -> Iterator[Tab]:
    one = browser.page()
    one.size(1280, 860)
    one.go(robot.url)
    one.wait("document.readyState === 'complete'")
    one.value(_MODULES)
    one.wait("document.querySelectorAll('.leg').length === 6 && state.now > 0")
    yield one
    one.close()


def test_nothing_is_answered_to_who_asks_for_everything(robot: Robot) -> None:
    with Link.open(client_settings([robot.endpoint])) as link:
        replies = link.query("robot/leg/**")
        kinds = {reply.key.rpartition("/")[2] for reply in replies}
        assert "model" in kinds
        assert "trace" not in kinds


@pytest.mark.slow
def test_it_draws_every_leg(tab: Tab) -> None:
    names = tab.value("[...document.querySelectorAll('.leg .name')].map(e => e.textContent)")
    assert names == LEGS
    begin = tab.value("state.now")
    tab.wait(f"state.now > {begin + 2000}")
    tab.wait("[...state.legs.values()].every(l => l.ticks.count > 50 && l.contacts.length > 0)")
    assert tab.value("[...state.legs.values()].map(l => l.ticks.joints)") == [3] * 6
    # What is drawn: blue of a contact, and the prediction's colour.
    for name in ("contact", "predicted", "stance", "ratio"):
        tab.wait(f"({_HAS_COLOUR})('{name}')")
    said = [line for line in tab.log if "willReadFrequently" not in line]  # of `_HAS_COLOUR`
    assert said == [], "the content policy and the console have nothing to say"


_HAS_COLOUR = """(name) => {
  const canvas = document.querySelector('.leg canvas');
  const pen = canvas.getContext('2d');
  const data = pen.getImageData(0, 0, canvas.width, canvas.height).data;
  const probe = document.createElement('canvas').getContext('2d');
  probe.fillStyle = theme.colour[name];
  probe.fillRect(0, 0, 1, 1);
  const [r, g, b] = probe.getImageData(0, 0, 1, 1).data;
  for (let i = 0; i < data.length; i += 4) {
    if (data[i] === r && data[i + 1] === g && data[i + 2] === b) return true;
  }
  return false;
}"""


@pytest.mark.slow
def test_a_leg_opens_with_its_joints_and_equations(tab: Tab) -> None:
    tab.value("document.querySelector('.leg').click()")
    tab.wait("document.querySelectorAll('.equation').length === 3")
    assert tab.value("document.querySelectorAll('#detail-plots canvas').length") == 4
    _values_can_be_read(tab)
    refit = tab.value("document.getElementById('detail-refit').textContent")
    assert re.match(r"Version \d+\. Refits: \d+ promoted, .* Last: .+\.", refit)
    assert "coxa" in tab.value("document.querySelector('.equation').textContent")
    tab.value("document.getElementById('detail-close').click()")
    assert tab.value("document.getElementById('detail').open") is False


def _values_can_be_read(tab: Tab) -> None:
    """One cursor over all plots of the leg: each says its values at the same time."""
    tab.wait("panel.charts.length === 4 && panel.charts[0].data[0].length > 50")
    tab.value("document.getElementById('live').click()")  # what is looked at stays
    tab.value(
        """(() => {
          const over = panel.charts[0].over;
          const box = over.getBoundingClientRect();
          const at = { clientX: box.left + 0.6 * box.width, clientY: box.top + 20, bubbles: true };
          over.dispatchEvent(new MouseEvent('mouseenter', at));
          over.dispatchEvent(new MouseEvent('mousemove', at));
        })()"""
    )
    tab.wait("panel.charts.every((one) => one.cursor.idx !== null)")
    shown = tab.value(
        "panel.charts.map((one) => [...one.root.querySelectorAll('.u-value')].map("
        "(value) => value.textContent))"
    )
    assert len({values[0] for values in shown}) == 1, shown
    assert re.fullmatch(r"-?\d+\.\d\d s", shown[0][0])
    time_s, p = tab.value(
        "[0, 2].map((row) => panel.charts[0].data[row][panel.charts[0].cursor.idx])"
    )
    assert shown[0][0] == f"{time_s:.2f} s"
    assert shown[0][2] == ("–" if p is None else f"{p:.2f}")
    carries = tab.value("panel.charts[0].data[2].filter((p) => p !== null)")
    assert 0.0 <= min(carries) < 0.3 < 0.7 < max(carries) <= 1.0
    for _, predicted, command, reading in shown[1:]:
        assert re.fullmatch(r"–|-?\d+\.\d\d°", predicted)
        assert abs(float(command[:-1]) - float(reading[:-1])) < 60
    tab.value("document.getElementById('live').click()")
    begin = tab.value("state.now")
    tab.wait(f"state.now > {begin + 1000}")  # the lines have gone on under the pointer
    time_s, reading, said = tab.value(
        "(() => { const one = panel.charts[1], i = one.posToIdx(one.cursor.left);"
        " const said = [...one.root.querySelectorAll('.u-value')].map((v) => v.textContent);"
        " return [one.data[0][i], one.data[3][i], said]; })()"
    )
    assert said[0] == f"{time_s:.2f} s"
    assert float(said[3][:-1]) == pytest.approx(reading, abs=0.006)


@pytest.mark.slow
def test_feet_from_above_are_red_while_they_touch(tab: Tab) -> None:
    tab.wait(
        "[...state.legs.values()].every((leg) => leg.places.length > 20 && leg.contacts.length)"
    )
    tab.wait("document.getElementById('above-note').textContent === 'by measured angles'")
    # Legs are where the robot has them: x forward, y to the left, mm.
    feet = tab.value("[...state.legs.values()].map((l) => l.places.at(-1)[1].slice(-2))")
    for name, (x, y) in zip(LEGS, feet, strict=True):
        assert (y > 0) is (name[0] == "l"), (name, x, y)
        assert {"f": x > 60, "m": abs(x) < 80, "r": x < -60}[name[1]], (name, x, y)
    # Looking back, the picture is of that time.
    tab.value("stream.source.close(); state.over = 'test'; forget(); state.span = 1000")
    tab.value(_CHANGES)
    for t, colour in ((2500, "bad"), (3500, "card"), (4500, "withheld")):
        tab.value(f"state.end = {t}; dispatchEvent(new Event('resize'))")
        assert _foot_is(tab, "rf", colour)
    # Without ticks nothing is known: the legs stand as they were measured last.
    note = "document.getElementById('above-note').textContent"
    assert tab.value(note) == "by measured angles"
    tab.value("state.end = state.now += 5000; dispatchEvent(new Event('resize'))")
    tab.wait(f"{note} === 'as measured last'")
    assert _foot_is(tab, "rf", "stance")
    # And without places they stand where their names say.
    tab.value("state.legs.get('rf').places = []; dispatchEvent(new Event('resize'))")
    tab.wait(f"{note}.startsWith('a scheme')")
    assert _foot_is(tab, "rf", "stance")


# A leg that touches at 2 s, lifts at 3 s, and has a contact withheld at 4 s.
_CHANGES = """
for (let t = 100; t <= 6000; t += 100) {
  const rows = [100, 80, 60, 40, 20].map((d) => [t - d, 0, 50, 90, 1, 2, 3, 4, 5, 6]);
  const changed = { 2000: [1, 150, 0], 3000: [0, 150, 0], 4000: [0, 150, 1] }[t];
  takeFrame({
    t, k: { rf: rows }, f: { rf: [100, -50, 200, -150] },
    e: changed ? [['rf', t, t, ...changed]] : [],
  });
}
"""


def _foot_is(tab: Tab, leg: str, colour: str) -> bool:
    """Whether a foot has a colour once it is drawn: that of the pixel beside its label."""
    return bool(
        tab.wait(
            f"above.feet.has('{leg}') && ({_FOOT_COLOUR})('{leg}') === "
            f"({_PIXEL_OF})(theme.colour['{colour}'])"
        )
    )


_PIXEL_OF = """(colour) => {
  const probe = document.createElement('canvas').getContext('2d');
  probe.fillStyle = colour;
  probe.fillRect(0, 0, 1, 1);
  return [...probe.getImageData(0, 0, 1, 1).data].join();
}"""
_FOOT_COLOUR = """(leg) => {
  const canvas = document.getElementById('above-canvas');
  const ratio = canvas.width / canvas.clientWidth;
  const [x, y] = above.feet.get(leg).map((at) => Math.round(at * ratio));
  return [...canvas.getContext('2d').getImageData(x, y, 1, 1).data].join();
}"""


@pytest.mark.slow
def test_a_mark_stands_over_all_plots_and_can_be_gone_back_to(tab: Tab) -> None:
    tab.value("document.getElementById('mark-label').value = ' <b>slip</b> '")
    tab.value("document.getElementById('mark').click()")
    key = "document.dispatchEvent(new KeyboardEvent('keydown', { key: 'm', %s }))"
    tab.value(key % "ctrlKey: true")  # a browser's own
    tab.value("document.getElementById('mark-label').value = ''")
    tab.value(key % "")
    texts = tab.value("[...document.querySelectorAll('#marks button')].map((e) => e.textContent)")
    assert [text[9:] for text in texts] == ["mark 2", "<b>slip</b>"]
    assert all(re.match(r"\d\d:\d\d:\d\d ", text) for text in texts)
    tab.value("document.querySelector('.leg').click()")
    tab.wait("document.querySelectorAll('#detail-plots canvas').length === 4")
    tab.wait(
        "[...document.querySelectorAll('.leg canvas, #detail-plots canvas')].slice(0, 4)"
        f".every({_MARK_DRAWN}) && [...document.querySelectorAll('#detail-plots canvas')]"
        f".every({_MARK_DRAWN})"
    )
    begin = tab.value("state.now")
    tab.wait(f"state.now > {begin + 6000}")
    tab.value("document.querySelector('#marks button').click()")
    tab.wait(
        "state.end !== null && Math.abs(state.end - state.span / 2 "
        "- (state.marked.at(-1)[0] - state.clockMs)) < 5"
    )


# Of columns of pixels, one is of the mark's colour from top to bottom.
_MARK_DRAWN = f"""(canvas) => {{
  const {{ width, height }} = canvas;
  const data = canvas.getContext('2d').getImageData(0, 0, width, height).data;
  const wanted = ({_PIXEL_OF})(theme.colour.accent);
  for (let x = 0; x < width; x += 1) {{
    let found = 0;
    for (let y = 0; y < height; y += 1) {{
      const i = 4 * (y * width + x);
      if (data.slice(i, i + 4).join() === wanted) found += 1;
    }}
    if (found > height / 2) return true;
  }}
  return false;
}}"""


@pytest.mark.slow
def test_the_page_starts_and_stops_a_recording(
    robot: Robot, browser: Chromium, tmp_path: Path
) -> None:
    page = begun(
        *("watch", "--web", "--no-browser", "--connect", robot.endpoint),
        *("--record-to", str(tmp_path)),
    )
    tab = browser.page()
    try:
        tab.go(page.wait_line(r"live page at (http://\S+)").group(1))
        tab.wait("document.querySelectorAll('.leg').length === 6")
        tab.wait("!document.getElementById('recording').hidden")
        press = "document.getElementById('record').click()"
        shown = "document.getElementById('recorded').textContent"
        tab.value(press)
        tab.wait("document.getElementById('record').textContent.includes('stop')")
        tab.value("document.getElementById('mark').click()")
        tab.wait(f"/, [1-9]\\d* kB, [1-9]\\d* s/.test({shown})")
        tab.value(press)
        tab.wait("document.getElementById('record').textContent.includes('record')")
        (file,) = tmp_path.iterdir()
        name, size, _ = tab.value(shown).split(", ")
        assert (name, size) == (file.name, f"{round(file.stat().st_size / 1e3)} kB")
        keys = {record.key.rpartition("/")[2] for record in Recording(file)}
        assert {"mark", "servo", "contact"} <= keys
        assert tab.log == []
    finally:
        tab.close()
        assert page.stop() == 0
        page.close()


@pytest.mark.slow
def test_it_looks_back(tab: Tab) -> None:
    tab.value("document.getElementById('span').value = '3000'")
    tab.value("document.getElementById('span').dispatchEvent(new Event('change'))")
    tab.wait("document.getElementById('scrub').min < -2500")  # drawn: a value below it is raised
    # At once, as a hand does it: the next frame puts the slider back to now.
    end = tab.value(
        "(() => { const scrub = document.getElementById('scrub'); scrub.value = '-2500';"
        " scrub.dispatchEvent(new Event('input')); return state.end })()"
    )
    assert end is not None
    begin = tab.value("state.now")
    tab.wait(f"state.now > {begin + 500}")
    assert tab.value("state.end") == end, "what is looked at stays"
    assert "ago" in tab.value("document.getElementById('when').textContent")
    tab.value("document.getElementById('live').click()")
    tab.wait("state.end === null && document.getElementById('when').textContent === 'now'")


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390, 768, 1280])
def test_it_fits_a_phone(tab: Tab, width: int) -> None:
    tab.size(width, 844, phone=width < 500)
    tab.wait(f"innerWidth === {width}")
    assert tab.value("document.documentElement.scrollWidth") <= width
    tab.value("state.legs.get('rf').card.root.click()")
    tab.wait("document.querySelectorAll('.equation').length === 3")
    assert tab.value("document.documentElement.scrollWidth") <= width
    tab.value("document.getElementById('detail-close').click()")


@pytest.mark.slow
def test_text_of_the_wire_is_text(robot: Robot, tab: Tab) -> None:
    """A note that would be a page of its own is shown, letter by letter."""
    note = '<img src=x onerror="document.title=1"><script>alert(1)</script>\u202e\x1b[2J'
    status = LearnerStatus(
        leg="rf",
        t_ns=0,
        status="ambiguous",
        model_version=1,
        residual_rms=[0.0] * 3,
        noise_floor=[0.0] * 3,
        note=note,
    )
    with Link.open(client_settings([robot.endpoint])) as link:
        publisher = link.publisher(learner_key("rf"))

        def seen() -> str | None:  # until the learner's own status, twice a second
            publisher.put(status)
            found: str = tab.value("document.getElementById('banner').textContent")
            return found if "<script>alert(1)</script>" in found else None

        text = until(seen, "the note in the banner")
    assert "\\u202e\\u001b[2J" in text
    assert tab.value("document.querySelectorAll('#banner img, #banner script').length") == 0
    assert tab.value("document.title") != "1"
    policy = tab.value(
        "(() => { try { document.body.innerHTML = '<b>x</b>' } catch (e) { return e.name } })()"
    )
    assert policy == "TypeError", "trusted types are asked for"


@pytest.mark.slow
def test_its_memory_is_flat(tab: Tab) -> None:
    """Two hours of frames, as fast as they go: what is kept after half an hour stays as it is."""
    tab.value("stream.source.close(); state.over = 'test'; forget()")
    tab.value(_FEED)
    sizes = []
    for half_hour in range(4):
        tab.value(f"feedFrames({half_hour * 18_000}, 18_000)")
        tab.call("HeapProfiler.collectGarbage")
        sizes.append(tab.metrics()["JSHeapUsedSize"] / 1e6)
    kept = tab.value("[...state.legs.values()].map(l => [l.ticks.count, l.contacts.length])")
    assert kept == [[15_000, kept[0][1]]] * 6, "five minutes of 50 Hz"
    assert kept[0][1] < 1000
    assert sizes[-1] - sizes[0] < 0.5, f"MB of the heap after each half hour: {sizes}"


@pytest.mark.slow
def test_an_outage_is_drawn_as_a_gap(tab: Tab, tmp_path: Path) -> None:
    """No event says that the contact of a source that died in stance is not known."""
    tab.value("stream.source.close(); state.over = 'test'; forget(); state.span = 20000")
    tab.value(_OUTAGE)
    tab.wait("document.getElementById('legs').style.getPropertyValue('--columns') === '1'")
    for drawn in ("rf", "panel"):
        if drawn == "panel":
            tab.value("state.legs.get('rf').card.root.click()")
        tab.value("dispatchEvent(new Event('resize'))")  # which draws
        tab.wait(f"coloursOf(1100, 3900, {json.dumps(drawn)}).includes('predicted')")
        tab.picture(tmp_path / f"{drawn}.png")
        before, gap, after = (
            set(tab.value(f"coloursOf({begin}, {end}, {json.dumps(drawn)})"))
            for begin, end in ((1100, 3900), (4200, 11800), (12100, 13900))
        )
        assert "predicted" in before
        assert drawn == "panel" or before >= {"contact", "truth", "stance", "carries"}
        assert not gap & {"contact", "stance", "truth", "predicted", "reading", "ratio", "carries"}
        assert not after & {"contact", "truth"}, "whether the foot stands is not known again yet"
        assert "predicted" in after
    assert "unknown" in tab.value("document.querySelector('.leg .state').textContent")


# Ticks and truth of a leg in stance, 8 s without, and ticks again; colours between two times.
_OUTAGE = """
for (let t = 100; t <= 14000; t += 100) {
  const comes = t < 4000 || t >= 12000;
  const k = comes ? { rf: [0, 20, 40, 60, 80].map((d) => [
    t + d, 0, 50, d % 40 ? 95 : 90,
    ...[0, 1, 2].map((j) => Math.round(1000 * Math.sin((t + d) / 300 + j))),
    500, 600, 700, 510, 610, 710]) } : {};
  const once = t === 1000 ? { e: [['rf', t, t, 1, 150, 0]], g: [['rf', t, 1]] } : {};
  takeFrame({ t, k, ...once });
}
globalThis.coloursOf = (begin, end, drawn) => {
  const chart = drawn === 'panel' && panel.charts[1];
  const canvas = drawn === 'panel'
    ? document.querySelectorAll('#detail-plots canvas')[1] : state.legs.get(drawn).card?.canvas;
  if (!canvas) return [];
  const axis = plots.scale(canvas.clientWidth);
  const x = chart ? (t) => chart.valToPos((t - state.now) / 1000, 'x', true) : axis.x;
  const [left, right] = [begin, end].map((t) => Math.round(x(t)));
  const { data } = canvas.getContext('2d').getImageData(left, 0, right - left, canvas.height);
  const probe = document.createElement('canvas').getContext('2d');
  return Object.keys(theme.colour).filter((name) => {
    probe.fillStyle = theme.colour[name];
    probe.fillRect(0, 0, 1, 1);
    const [r, g, b] = probe.getImageData(0, 0, 1, 1).data;
    for (let i = 0; i < data.length; i += 4) {
      if (data[i] === r && data[i + 1] === g && data[i + 2] === b) return true;
    }
    return false;
  });
};
"""

_FEED = """
globalThis.feedFrames = (first, count) => {
  const names = ['lf', 'lm', 'lr', 'rf', 'rm', 'rr'];
  for (let n = first; n < first + count; n += 1) {
    const t = 1e6 + n * 100;
    const k = {};
    for (const name of names) {
      k[name] = [];
      for (let i = 0; i < 5; i += 1) {
        k[name].push([t + i * 20, n % 2, 12, 90, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
      }
    }
    const frame = { t: t + 100, k };
    if (n % 5 === 0) {
      frame.e = names.map((name) => [name, t, t, n % 10 ? 0 : 1, 150, 0]);
      frame.g = names.map((name) => [name, t, n % 10 ? 0 : 1]);
      frame.v = names.map((name) => [name, 'missed', t]);
    }
    takeFrame(frame);
  }
}
"""


def test_a_port_in_use_and_options_that_do_not_go_together_are_one_line(robot: Robot) -> None:
    port = robot.url.rstrip("/").rpartition(":")[2]
    for args, line in (
        (("--web", "--no-browser", "--port", port), f"port {port} of 127.0.0.1 is in use; give"),
        (("--web", "--json"), "--web shows a page; leave --once and --json out"),
        (("--port", "1234"), "are of the page; give --web"),
    ):
        second = begun("watch", *args, "--connect", robot.endpoint)
        assert second.wait() == 2
        second.close()
        assert len(second.lines) == 1
        assert line in second.lines[0]


def test_the_page_is_there_before_the_router_is() -> None:
    page = begun("watch", "--web", "--no-browser", "--connect", "tcp/127.0.0.1:1")
    try:
        url = page.wait_line(r"live page at (http://\S+)").group(1)
        line = "nobody listens on tcp/127.0.0.1:1"
        until(lambda: line in banner(url), line)
        assert page.stop() == 0
    finally:
        page.close()


def test_the_service_goes_and_comes_back(robot: Robot) -> None:
    """Last, as it ends the service: the page says so, and a page that ends is ended well."""
    robot.parts[0].stop()
    until(lambda: "the router is lost" in banner(robot.url), "the banner", 30)
    robot.begin("serve", "--no-state", "--listen", robot.endpoint)
    until(lambda: "router" not in banner(robot.url), "the banner without it", 60)
    assert robot.page.stop(signal.SIGTERM) == 0
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(robot.url, timeout=5)
