"""The page in a real browser: it renders without complaints, its pictures load, its links lead somewhere, nothing
overflows, on a desk as on a phone, and it prints.

Skipped where no Chromium is on the path.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import mujoco
import numpy as np
import pytest
from made_up_gap import make_gap
from made_up_run import make_run, make_whole

from droid_jax.report import page, viewer
from droid_jax.storage import write_npz

BROWSER = next((b for b in ("chromium", "chromium-browser", "google-chrome") if shutil.which(b)), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium or google-chrome on the path")

# The page itself runs no script and forbids it; the probe is a copy with the policy opened for this one.
PROBE = """<script>
addEventListener('load', () => {
  const images = [...document.images], seen = e => e.getClientRects().length > 0;
  const links = [...document.links], here = a => a.hash && a.pathname === location.pathname;
  const found = {
    images: images.length,
    loaded: images.filter(i => i.complete && i.naturalWidth > 0).length,
    wide: [...document.querySelectorAll('figure .wide')].filter(seen).length,
    narrow: [...document.querySelectorAll('figure .narrow')].filter(seen).length,
    drawn: [...document.querySelectorAll('svg')].filter(s => seen(s) && s.getBBox().width > 50).length,
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    width: document.documentElement.clientWidth,
    anchors: links.filter(here).length,
    dangling: links.filter(a => here(a) && !document.getElementById(decodeURIComponent(a.hash.slice(1)))).length,
    files: links.filter(a => a.protocol === 'file:' && !here(a)).map(a => decodeURIComponent(a.pathname)),
  };
  parent.postMessage(encodeURIComponent(JSON.stringify(found)), '*');
});
</script></body>"""
# Chromium makes no window as narrow as a phone; a frame can be.
FRAME = """<!doctype html><body style="margin:0"><iframe src="{src}" style="border:0;width:{width}px;height:{height}px">
</iframe><script>
addEventListener('message', e => document.documentElement.setAttribute('data-found', e.data));
</script></body>"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return page.write_report(make_run(tmp_path_factory.mktemp("browser") / "run"))


@pytest.fixture(scope="module")
def gap_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return page.write_report(make_gap(tmp_path_factory.mktemp("browser") / "gap", "partly explained"))


@pytest.fixture(scope="module")
def whole_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of all stages, as the command without arguments writes it."""
    folder = tmp_path_factory.mktemp("browser") / "all"
    make_whole(folder)
    for part in ("identify", "gap", "train"):
        page.write_report(folder / part)
    return page.write_report(folder)


def _browse(url: Path, *options: str, size: tuple[int, int]) -> subprocess.CompletedProcess[str]:
    command = [
        str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
        "--enable-logging=stderr", f"--user-data-dir={url.parent / 'profile'}",
        f"--window-size={size[0]},{size[1]}", *options, url.resolve().as_uri(),
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=90, check=True)


def _console(stderr: str) -> list[str]:
    """Console messages about the page, without those about a machine without a display."""
    return [line for line in stderr.splitlines() if "CONSOLE" in line]


SIZES = pytest.mark.parametrize(
    ("size", "shown", "hidden"),
    [
        pytest.param((1200, 900), "wide", "narrow", marks=pytest.mark.slow),
        pytest.param((834, 1112), "wide", "narrow", marks=pytest.mark.slow),  # a tablet
        ((720, 900), "wide", "narrow"),
        pytest.param((500, 900), "narrow", "wide", marks=pytest.mark.slow),
        ((375, 812), "narrow", "wide"),  # a phone
    ],
)


def _probe(report: Path, size: tuple[int, int]) -> dict[str, Any]:
    """Measures of a page drawn by the browser at this size; its console must be empty."""
    probe, frame = report.with_name("probe.html"), report.with_name("frame.html")
    text = report.read_text(encoding="utf-8")
    opened = text.replace("default-src 'none';", "default-src 'none'; script-src 'unsafe-inline';")
    probe.write_text(opened.replace("</body>", PROBE), encoding="utf-8")
    frame.write_text(FRAME.format(src=probe.name, width=size[0], height=size[1]), encoding="utf-8")
    done = _browse(frame, "--dump-dom", size=(max(size[0], 500), size[1]))
    assert not _console(done.stderr)
    (said,) = re.findall(r'data-found="([^"]*)"', done.stdout[:10_000])
    found = json.loads(unquote(said))
    assert found["width"] == size[0]
    return found


@SIZES
def test_everything_is_drawn_and_nothing_overflows(
    report: Path, size: tuple[int, int], shown: str, hidden: str
) -> None:
    found = _probe(report, size)
    assert found["images"] == found["loaded"] == 5
    vectors = 7 if shown == "wide" else 6  # the narrow figure of torques and residuals is a picture: the fifth image
    assert found[shown] == 7 and found[hidden] == 0
    assert found["drawn"] == vectors
    assert found["overflow"] == 0


@pytest.mark.slow
@SIZES
def test_the_search_for_a_missing_effect_is_drawn_too(
    gap_report: Path, size: tuple[int, int], shown: str, hidden: str
) -> None:
    found = _probe(gap_report, size)
    assert found["images"] == 0  # every figure is short enough to be an SVG
    assert found[shown] == found["drawn"] == 8 and found[hidden] == 0  # closed ones have a size too
    assert found["overflow"] == 0


@pytest.mark.slow
@SIZES
def test_the_page_of_all_stages_is_drawn_and_its_links_lead_somewhere(
    whole_report: Path, size: tuple[int, int], shown: str, hidden: str
) -> None:
    found = _probe(whole_report, size)
    assert found["images"] == found["loaded"] > 0
    assert found[shown] == found["drawn"] > 15 and found[hidden] == 0
    assert found["overflow"] == 0
    assert found["anchors"] == 3 and found["dangling"] == 0  # the list of its parts
    lost = [file for file in found["files"] if not Path(file).exists()]
    assert not lost and len(found["files"]) > 2


@pytest.mark.slow
def test_a_link_that_leads_nowhere_is_seen(whole_report: Path) -> None:
    """The check above can fail."""
    text = whole_report.read_text(encoding="utf-8")
    broken = whole_report.with_name("broken.html")
    broken.write_text(text.replace("</body>", '<a href="#nowhere">a</a><a href="no.html">b</a></body>'), "utf-8")
    found = _probe(broken, (1200, 900))
    assert found["dangling"] == 1
    assert [Path(file).name for file in found["files"] if not Path(file).exists()] == ["no.html"]


def test_the_page_as_it_is_renders_without_a_complaint(report: Path) -> None:
    picture = report.with_name("page.png")
    done = _browse(report, f"--screenshot={picture}", size=(1200, 1600))
    assert not _console(done.stderr)
    from matplotlib.image import imread

    pixels = imread(picture)[..., :3]
    assert pixels.shape == (1600, 1200, 3)
    assert pixels.mean() > 0.8 and (pixels.min(axis=2) < 0.3).mean() > 0.005  # a light page with dark text
    colourful = np.ptp(pixels, axis=2) > 0.3
    assert colourful.mean() > 0.002  # the figures' colours


SEEK = """<script>
const row = data.time.length - 1, picture = document.getElementById("after");
slider.value = row;
slider.dispatchEvent(new Event("input"));
const x = [...document.querySelectorAll(".cursor")].map(c => Number(c.getAttribute("x1")));
document.documentElement.dataset.found = encodeURIComponent(JSON.stringify({
  now: now.textContent, last: picture.src === data.pictures.after[row], cursors: x,
  lines: document.querySelectorAll("polyline").length,
}));
</script></body>"""


def test_the_viewer_moves_pictures_and_cursors_with_its_slider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='a'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    monkeypatch.setattr(
        viewer, "rendered_frames", lambda _, states, rows, *__: [np.full((4, 6, 3), 20 * r, np.uint8) for r in rows]
    )
    states = np.linspace(0.0, 1.0, 9)[:, None]
    write_npz(
        tmp_path / "replay.npz",
        {"time": np.arange(9) / 25.0, "before": states + 0.2, "after": states + 0.1, "measured": states,
         "measured_joints": np.array(["a"]), "recording": np.array("pull"), "start": np.array(0.0)},
    )  # fmt: skip
    page_of_motion = viewer.write_viewer(tmp_path, model)
    page_of_motion.write_text(page_of_motion.read_text().replace("</body>", SEEK), encoding="utf-8")
    done = _browse(page_of_motion, "--dump-dom", size=(1200, 900))
    assert not _console(done.stderr)
    (said,) = re.findall(r'data-found="([^"]*)"', done.stdout[:10_000])
    found = json.loads(unquote(said))
    assert found == {"now": "0.32 s", "last": True, "cursors": [600, 600], "lines": 5}


def test_the_console_is_really_read(report: Path) -> None:
    """The check above can fail: a page that breaks its own policy is reported."""
    broken = report.with_name("broken.html")
    text = report.read_text(encoding="utf-8")
    broken.write_text(text.replace("</body>", "<script>1</script></body>"), encoding="utf-8")
    assert _console(_browse(broken, "--dump-dom", size=(800, 600)).stderr)


def _pages(report: Path) -> int:
    """Sheets of paper that a page takes."""
    paper = report.with_suffix(".pdf")
    _browse(report, f"--print-to-pdf={paper}", "--no-pdf-header-footer", size=(1200, 900))
    content = paper.read_bytes()
    assert content.startswith(b"%PDF")
    return len(re.findall(rb"/Type\s*/Page\b", content))


@pytest.mark.slow
def test_it_prints(report: Path) -> None:
    assert 3 <= _pages(report) <= 14


@pytest.mark.slow
def test_the_page_of_all_stages_prints_with_what_is_folded(whole_report: Path) -> None:
    text = whole_report.read_text(encoding="utf-8")
    assert "<details>" in text
    opened = whole_report.with_name("opened.html")
    opened.write_text(text.replace("<details>", "<details open>"), encoding="utf-8")
    assert 12 <= _pages(whole_report) == _pages(opened) <= 26
