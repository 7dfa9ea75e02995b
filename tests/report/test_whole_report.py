"""One page for several stages: each in its folder, a paragraph at the top, links that work."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from made_up_gap import make_gap
from made_up_policy import make_policy
from made_up_run import make_run
from reader import read_page

from droid_jax.report import page


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = tmp_path_factory.mktemp("whole") / "run"
    make_run(whole / "identify")
    make_gap(whole / "gap")
    make_policy(whole / "train")
    (whole / "train" / "policy.npz").write_bytes(b"")
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
    assert "parameters were fitted to what the stand-in robot measured" in lead and "N m in “open_close”" in lead
    assert "of the gap on" in lead and "The policy opens the door in 95 % of its trials on the stand-in robot." in lead
    assert '<span class="next">Next: python -m droid_jax.run export' in lead


def test_the_links_lead_to_files_of_the_stages(folder: Path, text: str):
    links = re.findall(r'<a href="([^"#]+)" download>', text)
    assert {"identify/fit.json", "gap/gap.json", "train/policy.npz"} <= set(links)
    assert all((folder / link).is_file() for link in links)


def test_a_stage_alone_has_no_lead(tmp_path: Path):
    made = make_policy(tmp_path / "run" / "train")
    page.write_report(made.parent)
    assert 'class="summary lead"' not in (made.parent / "report.html").read_text()
