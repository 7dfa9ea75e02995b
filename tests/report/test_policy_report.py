"""The page of a trained policy: its numbers are the files', and it says what to do next."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from made_up_gap import make_gap
from made_up_policy import make_policy, training_json
from reader import read_page

from droid_jax.policy.trials import BLOWN_UP
from droid_jax.report import page, policy_words
from droid_jax.report.gap_folder import read_gap
from droid_jax.report.policy_folder import read_policy
from droid_jax.report.policy_words import policy_summary


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = make_policy(tmp_path_factory.mktemp("policy") / "run")
    page.write_report(made)
    return made


def test_the_page_shows_what_the_files_hold(folder: Path):
    text = (folder / "report.html").read_text().replace("\u00a0", " ")
    transfer = json.loads((folder / "transfer.json").read_text())
    for name in ("simulation", "synthetic_robot"):
        assert f'<data value="{transfer[name]["success_rate"]}">' in text
    assert "98 %" in text and "95 %" in text  # 39 and 38 of 40
    assert text.count("data:image/webp;base64,") == 2
    assert "not hardware" in text and "The synthetic robot hid closer (2.00)" in text
    assert "2 million actions in 7 minutes" in text and "succeeded in 96 % of its episodes" in text
    for stem in ("learning", "angles"):
        assert (folder / "figures" / f"{stem}.pdf").is_file() and f'id="{stem}"' in text
    assert read_page(folder / "report.html")


@pytest.mark.parametrize(
    ("successes", "simulated", "next_step"),
    [
        (None, None, "Next: python -m droid_jax.run evaluate"),
        (38, None, "Next: python -m droid_jax.run export"),
        (10, None, "search the gap"),
        (0, 0.1, "has not learned the task in simulation yet"),
    ],
)
def test_it_says_what_to_do_next(tmp_path: Path, successes: int | None, simulated: float | None, next_step: str):
    made = make_policy(tmp_path / "run", successes)
    if simulated is not None:
        content = json.loads((made / "transfer.json").read_text())
        content["simulation"]["success_rate"] = simulated
        (made / "transfer.json").write_text(json.dumps(content))
    assert next_step in policy_summary(read_policy(made))[-1]
    if next_step == "search the gap":
        searched = read_gap(make_gap(tmp_path / "gap", "named"))
        said = policy_summary(read_policy(made), searched)[-1]
        assert next_step not in said and f"train --fit {tmp_path / 'gap'}" in said
        assert "look at the film" in policy_summary(read_policy(made), read_gap(make_gap(tmp_path / "no", "none")))[-1]


def test_a_training_that_reached_95_percent_in_no_evaluation_is_not_tried_but_made_longer(tmp_path: Path):
    """One evaluation at 95 % is enough: the best policy is kept."""
    for best, learned in ((0.94, False), (0.95, True)):
        history = [{"step": 1, "seconds": 1.0, "rate": 1.0, "reward": 1.0, "success": s} for s in (0.0, best, 0.5)]
        said = policy_summary(read_policy(make_policy(tmp_path / f"{best}", None, history=history)))[-1]
        assert ("has not learned" in said) is not learned and ("droid_jax.run evaluate" in said) is learned


def test_a_synthetic_robot_that_was_not_fitted_says_little(tmp_path: Path):
    said = policy_summary(read_policy(make_policy(tmp_path / "run", 10, synthetic_robot={})))
    assert "The fit is of your own recordings" in said[-2] and "was to be expected" in said[-1]


def test_what_it_was_trained_on_is_said(tmp_path: Path):
    made = make_policy(tmp_path / "a", None, effects=["door_closer"])
    assert (
        "doors drawn from the fitted distribution, whose model holds door closer"
        in policy_summary(read_policy(made))[0]
    )
    setup = {"method": "fitted", "preset": "quick", "knob": 0, "seed": 3, "fit": None}
    other = make_policy(tmp_path / "b", None, setup=setup)
    assert "what was assumed before any fit" in policy_summary(read_policy(other))[0]


def test_a_search_and_a_policy_share_a_page(tmp_path: Path):
    made = make_gap(tmp_path / "run")
    make_policy(tmp_path / "policy", None)
    (made / "training.json").write_text((tmp_path / "policy" / "training.json").read_text())
    text = page.write_report(made).read_text()
    assert '<a href="#missing">' in text and '<a href="#policy">' in text and 'id="policy"' in text


@pytest.mark.parametrize(
    ("name", "content", "fault"),
    [
        ("training.json", "{}", "training.json lacks .*'setup'.*run train` again"),
        ("training.json", "{", "cannot be read"),
        ("transfer.json", '{"simulation": {}}', "lacks .*run evaluate` again"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, name: str, content: str, fault: str):
    made = make_policy(tmp_path / "run")
    (made / name).write_text(content)
    with pytest.raises(ValueError, match=fault):
        page.write_report(made)


@pytest.mark.parametrize(
    ("name", "change", "fault"),
    [
        ("training.json", lambda of: of["setup"].pop("fit"), "'setup' lacks 'fit'"),
        ("training.json", lambda of: of["setup"].update(method="x"), "'method' must be one of"),
        ("training.json", lambda of: of["history"][-1].update(of=[]), r"'of' must be a number, got \[\]"),
        (
            "training.json",
            lambda of: of["synthetic_robot"].update(springs="1"),
            "'springs' must be a whole number, got '1'",
        ),
        ("transfer.json", lambda of: of["robot"]["hidden"][0].update(joint=["x"]), "'joint' must be text or null"),
    ],
)
def test_what_the_page_reads_is_checked(tmp_path: Path, name: str, change, fault: str):
    made = make_policy(tmp_path / "run")
    content = json.loads((made / name).read_text())
    change(content)
    (made / name).write_text(json.dumps(content))
    with pytest.raises(ValueError, match=fault):
        page.write_report(made)


def test_trials_that_blew_up_are_said_and_not_counted() -> None:
    angle = {"mean": 40.0, "std": 1.0}
    found = {
        "trials": 10,
        "counted": 8,
        "stopped": {BLOWN_UP: 2},
        "interval_95": [0.68, 1.0],
        "success_rate": 1.0,
        "angle_deg": angle,
    }
    said = policy_words._tried("simulation", found, {"held": 0.5, "opened": 0.52})
    assert "in 100 % of 8 trials" in said and f"2 stopped: {BLOWN_UP}" in said


def test_trials_that_blew_up_are_in_no_figure_of_the_page(tmp_path: Path) -> None:
    made = make_policy(tmp_path / "run")
    transfer = json.loads((made / "transfer.json").read_text())
    robot = transfer["synthetic_robot"]
    each = [BLOWN_UP, BLOWN_UP, *[""] * (robot["trials"] - 2)]
    robot |= {"stopped": {BLOWN_UP: 2}, "stopped_each": each}
    (made / "transfer.json").write_text(json.dumps(transfer))
    found = read_policy(made).trials["synthetic robot"]
    assert found["counted"] == robot["trials"] - 2 and found["angles"] == robot["angle_deg"]["all"][2:]
    html = page.write_report(made).read_text()
    assert f'<td data-label="Trials">{robot["trials"] - 2}</td>' in html


def test_the_page_says_why_there_are_no_films(tmp_path: Path):
    made = make_policy(tmp_path / "run")
    for picture in (made / "films").iterdir():
        picture.unlink()
    content = json.loads((made / "transfer.json").read_text())
    (made / "transfer.json").write_text(json.dumps({**content, "no_films": "they were not asked for (--no-film)"}))
    assert "No films: they were not asked for (--no-film)." in read_page(page.write_report(made)).text


def test_a_training_that_ended_in_nan_says_so(tmp_path: Path):
    history = training_json()["history"]
    for last, ended in ((history, False), (history[:3], True)):
        said = " ".join(policy_summary(read_policy(make_policy(tmp_path / f"{len(last)}", None, history=last))))
        assert ("ended before the 2 million actions" in said) is ended
