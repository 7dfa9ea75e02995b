"""A check of a recording that failed is on the page of what was made from it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pytest
from made_up_gap import make_gap
from made_up_run import make_run

from droid_jax.preflight.findings import Finding
from droid_jax.report import page
from droid_jax.report.run_folder import read_run
from droid_jax.report.words import summary

WRONG = Finding("sign", "elbow", -0.99, 1.0, "certain", "recording 'x': the torque of <elbow> runs against its command")


@pytest.mark.parametrize(("make", "name"), [(make_run, "fit.json"), (make_gap, "gap.json")])
def test_a_failed_check_is_on_the_page(make: Callable[[Path], Path], name: str, tmp_path: Path):
    folder = make(tmp_path / "run")
    page.write_report(folder)
    assert "A check of the recordings failed" not in (folder / "report.html").read_text()
    content = json.loads((folder / name).read_text())
    (folder / name).write_text(json.dumps({**content, "findings": [asdict(WRONG)]}))
    page.write_report(folder)
    html = (folder / "report.html").read_text()
    assert "A check of the recordings failed" in html
    assert "the torque of &lt;elbow&gt; runs against its command" in html
    (folder / name).write_text(json.dumps({**content, "findings": [{"kind": 3}]}))
    with pytest.raises(ValueError, match=rf"{name}: 'findings', entry 0"):
        page.write_report(folder)


def test_what_to_do_next_begins_with_it(tmp_path: Path):
    folder = make_run(tmp_path / "run")
    content = json.loads((folder / "fit.json").read_text())
    (folder / "fit.json").write_text(json.dumps({**content, "findings": [asdict(WRONG)]}))
    assert "do not train on this fit: mend the sign of the recording" in summary(read_run(folder))[-1]
