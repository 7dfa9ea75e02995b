"""One page for several stages: each in its folder, a paragraph at the top, links that work."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from made_up_gap import make_gap
from made_up_policy import make_policy
from made_up_run import make_run
from made_up_whole import make_whole
from reader import read_page

from droid_jax.report import page
from droid_jax.synthetic.hidden_effects import in_words


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("whole") / "run"
    make_whole(whole)
    page.write_report(whole)
    return whole


@pytest.fixture(scope="module")
def text(folder: Path) -> str:
    return (folder / "report.html").read_text().replace("\u00a0", " ")


def test_it_holds_every_part(folder: Path, text: str):
    assert read_page(folder / "report.html")
    for anchor in ("identification", "missing", "policy"):
        assert f'href="#{anchor}"' in text and f'id="{anchor}"' in text


def test_a_paragraph_says_what_was_fitted_what_is_missing_and_what_is_next(text: str):
    (lead,) = re.findall(r'<p class="summary lead">(.*?)</p>', text, re.S)
    assert "parameters were fitted to what the synthetic robot measured" in lead and "N m in “open_close”" in lead
    assert "of the gap on" in lead and "The policy opens the door in 95 % of its trials on the synthetic robot." in lead
    assert '<span class="next">Next: python -m droid_jax.run export' in lead


def test_what_the_synthetic_robot_hid_is_said_in_the_librarys_words_too(tmp_path: Path):
    make_gap(tmp_path / "gap")
    make_policy(tmp_path / "train")

    def lead() -> str:
        text = page.write_report(tmp_path).read_text().replace("\u00a0", " ")
        (found,) = re.findall(r'<p class="summary lead">(.*?)</p>', text, re.S)
        return found

    assert "hid" not in lead()
    (tmp_path / "recordings").mkdir()
    (tmp_path / "recordings" / "synthetic_robot.json").write_text('{"hide": ["closer=2"]}')
    assert "hid" not in lead()  # a robot's own recordings were searched, and the synthetic robot's lie beside them
    path = tmp_path / "gap" / "gap.json"
    searched = json.loads(path.read_text())
    searched["setup"] |= {
        "synthetic_robot": True,
        "hidden": in_words(["magnetic_catch=1.5", "detent=0.5"]),
    }
    path.write_text(json.dumps(searched))
    assert (
        "What the synthetic robot hid: magnetic catch (1.5 N m; in the library: latch) and detent (0.5 N m; the "
        "library "
        "has no form of it)." in lead()
    )


@pytest.mark.parametrize(
    ("verdict", "explained", "warned"),
    [
        ("unexplained", None, True),
        ("fit not converged", None, True),
        ("tie", None, False),
        ("partly explained", 0.0, True),
        ("partly explained", 0.49, True),
        ("partly explained", 0.51, False),
    ],
)
def test_a_policy_of_a_model_that_is_known_to_be_wrong_is_not_sent_to_a_robot(
    tmp_path: Path, verdict: str, explained: float | None, warned: bool
):
    make_gap(tmp_path / "gap", verdict, explained=explained)
    make_policy(tmp_path / "train")
    text = page.write_report(tmp_path).read_text().replace("\u00a0", " ")
    (lead,) = re.findall(r'<p class="summary lead">(.*?)</p>', text, re.S)
    assert ("do not take it to a robot" in lead) == warned
    assert ("Next: python -m droid_jax.run export" in lead) != warned
    if warned:
        (own,) = re.findall(r'<p class="answer.*?<span class="next">(.*?)</span>', text, re.S)
        assert own in lead


def test_a_policy_of_a_fit_that_is_far_off_is_not_sent_to_a_robot(tmp_path: Path):
    """Whatever the search found; and the policy's own part says the same as the lead."""
    for folder, gap in ((tmp_path / "with", True), (tmp_path / "without", False)):
        run = make_run(folder / "identify")
        fit = json.loads((run / "fit.json").read_text())
        fit["gap"]["open_close"] |= {"before": 1.22, "after": 1.1, "closed": 0.1}
        (run / "fit.json").write_text(json.dumps(fit | {"mean_square": 80.0}))
        make_policy(folder / "train")
        if gap:
            make_gap(folder / "gap", "named")
        text = page.write_report(folder).read_text().replace("\u00a0", " ")
        assert "Next: python -m droid_jax.run export" not in text
        assert text.count("on a fit that is far from the data: do not take it to a robot") == 2


def test_a_policy_of_the_extended_model_is_not_of_the_fit_that_is_far_off(tmp_path: Path):
    """A large missing effect leaves the base fit far off, and is in what the policy was trained on."""
    run = make_run(tmp_path / "identify")
    fit = json.loads((run / "fit.json").read_text())
    fit["gap"]["open_close"] |= {"before": 1.22, "after": 1.1, "closed": 0.1}
    (run / "fit.json").write_text(json.dumps(fit | {"mean_square": 80.0}))
    make_gap(tmp_path / "gap", "named")
    make_policy(tmp_path / "train")
    training = json.loads((tmp_path / "train" / "training.json").read_text())
    (tmp_path / "train" / "training.json").write_text(json.dumps(training | {"effects": ["latch at hinge"]}))
    text = page.write_report(tmp_path).read_text()
    assert "do not take it to a robot" not in text and "Next: python -m droid_jax.run export" in text


def test_a_search_that_did_not_settle_says_nothing_of_the_model(tmp_path: Path):
    make_gap(tmp_path / "gap", "fit not converged")
    make_policy(tmp_path / "train")
    text = page.write_report(tmp_path).read_text().replace("\u00a0", " ")
    assert text.count("of which no search could say whether it is right: do not take it to a robot") == 2
    assert "known to be wrong" not in text


def test_every_link_leads_to_a_file_of_a_stage(folder: Path):
    links = [link for link in read_page(folder / "report.html").links if not link.startswith("#")]
    assert {"identify/fit.json", "gap/gap.json", "train/policy.npz", "gap/figures/missing_gap.pdf"} <= set(links)
    assert [link for link in links if not (folder / link).is_file()] == []


def test_sections_lie_a_level_below_their_part(text: str):
    levels = [int(level) for level in re.findall(r"<h(\d)", text)]
    assert levels.count(1) == 1 and max(levels) == 4
    sections = dict(re.findall(r"<h([23])>(How large the gap is|Search|Trials|Files)</h", text))
    assert sections == {"3": "Trials", "2": "Files"}


def test_pictures_are_described_and_not_called_by_their_title_alone(text: str):
    described = re.findall(r'<(?:svg role="img"|img class="card")[^>]* aria-describedby="([^"]+)"', text)
    assert described and all(text.count(f'id="{name}"') == 1 for name in described)
    films = re.findall(r'<img alt="([^"]*)" src="data:image/webp[^>]*><figcaption>([^<]*)<', text)
    assert films and all(seen != caption and "arm" in seen for seen, caption in films)


def test_a_stage_alone_has_no_lead(tmp_path: Path):
    made = make_policy(tmp_path / "run" / "train")
    page.write_report(made.parent)
    assert 'class="summary lead"' not in (made.parent / "report.html").read_text()


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
