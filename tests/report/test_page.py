"""One page for several stages: each in its folder, a paragraph at the top, links that work."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from made_up_gap import make_gap
from made_up_run import make_policy, make_run, make_whole
from reader import Page, read_page, spaced

from droid_jax.commands import report
from droid_jax.report import page
from droid_jax.synthetic.hidden_effects import in_words


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, one_line: None) -> Path:
    whole = tmp_path_factory.mktemp("whole") / "run"
    make_whole(whole)
    page.write_report(whole)
    return whole


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    return (folder / "report.html").read_text()


@pytest.fixture(scope="module")
def written(folder: Path) -> Page:
    return read_page(folder / "report.html")


def test_it_holds_every_part(written: Page):
    for anchor in ("identification", "missing", "policy"):
        assert f"#{anchor}" in written.links and anchor in written.ids


def test_a_paragraph_has_the_answer_of_every_part(written: Page):
    lead = spaced(written.ids["lead"]["text"])
    assert "8 parameters and 2 nuisances were fitted" in lead and "fell from 1.22 to 0.119 N m" in lead
    assert "The model lacks: latch at door hinge." in lead and "99 % of the discrepancy on “C” is closed" in lead
    assert "The policy opens the door in 95 % of its trials on the synthetic robot." in lead
    following = written.ids["lead-next"]
    assert following["data-next"] == "export" and "python -m droid_jax.run export" in following["text"]


def test_what_the_synthetic_robot_hid_is_said_in_the_librarys_words_too(tmp_path: Path, quick: None):
    make_gap(tmp_path / "gap")
    make_policy(tmp_path / "train")

    def lead() -> str:
        return spaced(read_page(page.write_report(tmp_path)).ids["lead"]["text"])

    assert "Hidden" not in lead()
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "synthetic_robot.json").write_text('{"hide": ["closer=2"]}')
    assert "Hidden" not in lead()  # a robot's own recordings were searched, and the synthetic robot's lie beside them
    path = tmp_path / "gap" / "gap.json"
    searched = json.loads(path.read_text())
    searched["setup"] |= {"synthetic_robot": True, "hidden": in_words(["magnetic_catch=1.5", "detent=0.5"])}
    path.write_text(json.dumps(searched))
    assert "robot: magnetic catch (1.5 N m; in the library: latch) and detent (0.5 N m; not in the library)" in lead()


@pytest.mark.parametrize(
    ("verdict", "explained", "wrong"),
    [
        ("unexplained", None, "wrong"),
        ("fit not converged", None, "unknown"),
        ("indistinguishable", None, ""),
        ("partly explained", 0.0, "wrong"),
        ("partly explained", 0.49, "wrong"),
        ("partly explained", 0.51, ""),
    ],
)
def test_a_policy_of_a_model_that_is_known_to_be_wrong_is_not_sent_to_a_robot(
    tmp_path: Path, quick: None, verdict: str, explained: float | None, wrong: str
):
    make_gap(tmp_path / "gap", verdict, explained=explained)
    make_policy(tmp_path / "train")
    written = read_page(page.write_report(tmp_path))
    following, own = written.ids["lead-next"], written.ids["gap-next"]
    assert following["data-wrong-model"] == wrong
    assert written.ids["policy-next"]["data-next"] == ("not to a robot" if wrong else "export")
    assert ("do not take it to a robot" in following["text"]) == bool(wrong) == ("wrong_model" in written.doubts)
    assert ("droid_jax.run export" in written.text) != bool(wrong)
    assert not wrong or spaced(own["text"]).strip() in spaced(following["text"])


@pytest.mark.parametrize("searched", [True, False])
def test_a_policy_of_a_fit_that_is_far_off_is_not_sent_to_a_robot(tmp_path: Path, quick: None, searched: bool):
    """Whatever the search found; and the policy's own part says the same as the lead."""
    _far_off(tmp_path)
    make_policy(tmp_path / "train")
    if searched:
        make_gap(tmp_path / "gap", "named")
    written = read_page(page.write_report(tmp_path))
    assert written.ids["lead-next"]["data-wrong-model"] == "far_off"
    assert written.ids["policy-next"]["data-next"] == "not to a robot" and "droid_jax.run export" not in written.text


def test_a_policy_of_the_extended_model_is_not_of_the_fit_that_is_far_off(tmp_path: Path, quick: None):
    """A large missing effect leaves the base fit far off, and is in what the policy was trained on."""
    _far_off(tmp_path)
    make_gap(tmp_path / "gap", "named")
    make_policy(tmp_path / "train", effects=["latch"])
    written = read_page(page.write_report(tmp_path))
    assert written.ids["lead-next"]["data-wrong-model"] == "" and written.ids["lead-next"]["data-next"] == "export"


def _far_off(folder: Path) -> None:
    run = make_run(folder / "identify")
    fit = json.loads((run / "fit.json").read_text())
    fit["heldout_distances"]["open_close"] |= {"before": 1.22, "after": 1.1, "closed": 0.1}
    (run / "fit.json").write_text(json.dumps(fit | {"mean_square": 80.0}))


def test_every_link_leads_to_a_file_of_a_stage(folder: Path, written: Page):
    links = [link for link in written.links if not link.startswith("#")]
    assert {"identify/fit.json", "gap/gap.json", "train/policy.npz", "gap/figures/missing_gap.pdf"} <= set(links)
    assert [link for link in links if not (folder / link).is_file()] == []


def test_ids_are_unique(html: str):
    ids = re.findall(r'\bid="([^"]+)"', html)
    assert len(ids) == len(set(ids))


def test_sections_lie_a_level_below_their_part(html: str):
    levels = [int(level) for level in re.findall(r"<h(\d)", html)]
    assert levels.count(1) == 1 and max(levels) == 4
    sections = dict(re.findall(r"<h([23])>(Discrepancy|Search|Trials|Files)</h", html))
    assert sections == {"3": "Trials", "2": "Files"}


def test_pictures_are_described_and_not_called_by_their_title_alone(html: str):
    described = re.findall(r'<(?:svg role="img"|img class="card")[^>]* aria-describedby="([^"]+)"', html)
    assert described and all(html.count(f'id="{name}"') == 1 for name in described)
    films = re.findall(r'<img alt="([^"]*)" src="data:image/webp[^>]*><figcaption>([^<]*)<', html)
    assert films and all(seen != caption and "arm" in seen for seen, caption in films)


def test_a_stage_alone_has_no_lead(tmp_path: Path, quick: None):
    made = make_policy(tmp_path / "run" / "train")
    assert "lead" not in read_page(page.write_report(made.parent)).ids


@pytest.mark.parametrize(
    ("hidden", "called"),
    [
        ("stribeck_friction[hinge]=1", "hinge stribeck"),
        ("directional_friction[hinge]=1", "hinge directional"),
        ("stribeck_friction[panda_joint2]=1", "joint stribeck"),
        ("stribeck_friction=1", "joint stribeck"),
        ("dry_friction[hinge]=1", "joint coulomb"),
    ],
)
def test_what_was_hidden_is_called_as_the_library_does_there(hidden: str, called: str):
    assert f"in the library: {called})" in in_words([hidden])


def test_pages_of_stages_are_drawn_by_processes_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_run(tmp_path / "run")
    (tmp_path / "run" / "report.html").unlink(missing_ok=True)
    with report.drawn_meanwhile():
        report.run(report.Report(tmp_path / "run"))
    assert "(is being drawn)" in capsys.readouterr().out and (tmp_path / "run" / "report.html").is_file()
    report.run(report.Report(tmp_path / "run"))  # and here outside
    assert "being drawn" not in capsys.readouterr().out


def test_what_the_drawing_process_says_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """At the latest at the end; an error of a stage waits for it too."""
    with pytest.raises(ValueError, match="of a stage"), report.drawn_meanwhile():
        report.run(report.Report(tmp_path / "nothing"))
        report.wait_for_pages()
        assert "report.html: error: " in capsys.readouterr().err
        raise ValueError("of a stage")


def test_a_signal_ends_the_drawing_too(tmp_path: Path):
    """The program ends at once, and so does the process that it began."""
    code = f"""
import subprocess, sys, time
from pathlib import Path
from droid_jax import console
from droid_jax.commands import report

def endless(folder):
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    print(process.pid, flush=True)
    return process

report._report_process = endless
console._watch_signals()
with report.drawn_meanwhile():
    report.run(report.Report(Path({str(tmp_path)!r})))
    time.sleep(600)
"""
    program = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert program.stdout is not None
    drawing = int(program.stdout.readline())
    program.stdout.readline()  # the page is being drawn
    program.terminate()
    _, said = program.communicate(timeout=30)
    assert program.returncode == 143 and said == "terminated\n"
    for _ in range(100):
        state = Path(f"/proc/{drawing}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.1)
    raise AssertionError("it still runs")
