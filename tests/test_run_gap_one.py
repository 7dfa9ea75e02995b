"""The command `gap` on one recording: its repeats in two halves, or a log cut into blocks of time."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_log import ASKED, CONFIG, COULOMB, elbow, elbow_log, write_elbow

from droid_jax import runtime
from droid_jax.commands import gap
from droid_jax.commands.gap_search import IN_BLOCKS
from droid_jax.cost.lone_log import LoneLog
from droid_jax.discrepancy import missing
from droid_jax.identify.extended_model import load_extended
from droid_jax.identify.search import CmaConfig
from droid_jax.recordings.formats import save_recording
from droid_jax.recordings.recording import Recording
from droid_jax.recordings.split import Split, pooled, roles_of, split_of
from droid_jax.report.gap_folder import Gap, read_gap
from droid_jax.run import main

SEARCH = replace(CONFIG, search=CmaConfig(population=8, parents=None, generations=2), max_effects=1)
LOG = elbow_log(COULOMB)
pytestmark = pytest.mark.usefixtures("one_line", "tuned")


def command(place: Path, recordings: Sequence[Recording], *options: str) -> list[str]:
    """A command line for the elbow."""
    for k, recording in enumerate(recordings):
        save_recording(recording, place / f"{k}.npz")
    files = [str(place / f"{k}.npz") for k in range(len(recordings))]
    return ["gap", "--recording", *files, *write_elbow(place), "--out", str(place / "run"), *options]


# ----- which way


def with_repeats(count: int) -> Recording:
    """A recording with commands."""
    time = np.arange(0.0, 2.0, 0.01)
    log = elbow_log(0.0, 2.0, count)
    return replace(log, name="servo", time=time, command=np.sin(time)[:, None], command_names=("elbow",))


def test_what_recordings_hold_says_how_they_are_used():
    logs = [LOG, replace(LOG, name="other")]
    assert split_of(logs[:1]) is split_of(logs) is Split.BLOCKS
    assert roles_of(Split.BLOCKS, logs) == {"train": logs[0], "test": logs[1]}
    assert split_of([with_repeats(16)]) is split_of([elbow_log(0.0, 2.0, repeats=16)]) is Split.REPEATS
    three = [with_repeats(8)] * 3
    assert split_of(three) is split_of(three[:2]) is Split.RECORDINGS
    assert list(roles_of(Split.RECORDINGS, three)) == ["train", "validation", "test"]


def test_halves_are_the_first_and_the_last_repeats():
    whole = elbow_log(0.0, 2.0, repeats=17)
    halves = roles_of(Split.REPEATS, [whole])
    names = {role: r.name for role, r in halves.items()}
    assert names == {"train": "elbow, first 8 repeats", "validation": "elbow, last 9 repeats"}
    joined = np.concatenate([r.channel("torque").values for r in halves.values()])
    np.testing.assert_array_equal(joined, whole.channel("torque").values)


def blind(count: int) -> Recording:
    """A commanded log without measured positions, in which no window can begin."""
    recording = with_repeats(count)
    return replace(recording, channels={"torque": recording.channel("torque")})


WINDOWS = "in which positions were measured are searched in windows of time"


@pytest.mark.parametrize(
    ("recordings", "expected"),
    [
        ([blind(15)], ["is the only one and has 15 repeats", "Record 16 or more", "droid_jax.run identify", WINDOWS]),
        ([blind(1)], ["is the only one and has 1 repeat:", "another motion, 8 repeats or more of each"]),
        ([blind(3)] * 2, ["the train recording 'servo' has 3 repeats:", WINDOWS]),
        ([elbow_log(0.0, 2.0, repeats=2)], ["has 2 repeats", "a single repeat is searched in blocks of time"]),
        ([LOG, elbow_log(0.0, 2.0, repeats=3)], ["the second recording 'elbow' has 3 repeats", "Leave the second out"]),
        ([LOG, with_repeats(1)], ["the second recording 'servo' has commands", "log without repeats and commands"]),
        ([LOG] * 3, ["the train recording 'elbow' has 1 repeat:", "fewer than 8", "droid_jax.run identify"]),
        ([with_repeats(8), LOG], ["the validation recording 'elbow' has 1 repeat:"]),
        ([blind(8)] * 4, ["one to three are searched", "got 4"]),
    ],
)
def test_too_few_repeats_say_what_can_still_be_done(recordings: list[Recording], expected: list[str]):
    with pytest.raises(ValueError) as refused:
        split_of(recordings)
    assert [words for words in expected if words not in str(refused.value)] == []


def test_commanded_logs_with_few_repeats_are_cut_into_windows():
    """Any number of logs with too few repeats for sign flips; further ones may be test data."""
    one, three = with_repeats(1), with_repeats(3)
    for recordings in ([one], [three], [with_repeats(15)], [one] * 5, [with_repeats(8), three], [with_repeats(8)] * 4):
        assert split_of(recordings) is Split.WINDOWS
    assert split_of([with_repeats(16)], [one]) is Split.WINDOWS
    roles = roles_of(Split.WINDOWS, [one, three], [with_repeats(2)])
    assert list(roles) == ["train", "train 2", "test"]
    assert pooled(roles, "train") == [one, three] and pooled(roles, "test") == [roles["test"]]
    with pytest.raises(ValueError, match=r"test recordings .* are for commanded logs whose positions were measured"):
        split_of([LOG], [one])


@pytest.mark.slow
def test_a_second_log_is_another_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(command(tmp_path, [LOG, LOG])) == 2
    assert "the train and the test recording are the same ('elbow')" in capsys.readouterr().err


@pytest.mark.slow
def test_a_log_that_is_too_short_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(command(tmp_path, [LOG.window(0.0, 4.5)], "--effects", *ASKED)) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and "4 are needed to distinguish an effect from noise" in said


# ----- one log


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A log's search, stopped and taken up again: its folder and what was printed at last."""
    place = tmp_path_factory.mktemp("log")
    words = command(place, [LOG], "--effects", *ASKED)
    find = missing.search_effects

    def killed(*arguments):
        find(*arguments)
        raise KeyboardInterrupt

    def remembered(*arguments):
        with pytest.MonkeyPatch.context() as inside:
            inside.setattr(LoneLog, "whitened", lambda *a: pytest.fail("this replay was kept"))
            return find(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runtime, "tune", lambda *a, **k: None)
        patch.setattr(missing, "search_effects", killed)
        assert main(words) == 130
        patch.setattr(missing, "search_effects", remembered)
        with contextlib.redirect_stdout(io.StringIO()) as said:
            assert main(words) == 0
    return place / "run", said.getvalue()


@pytest.fixture(scope="module")
def found(run: tuple[Path, str]) -> Gap:
    return read_gap(run[0])


def test_a_log_is_searched_and_its_limits_are_said(run: tuple[Path, str], found: Gap):
    lines = run[1].splitlines()[-7:]
    assert lines[0] == "The model lacks: joint_coulomb at elbow."
    assert "closed), test " in lines[3] and lines[4] == Split.BLOCKS.limits == found.found.split.limits
    assert found.found.split.by == "blocks" and "localisation cannot be distinguished from noise" in lines[4]
    (amplitude,) = found.found.coefficients
    assert amplitude.low < COULOMB < amplitude.high and amplitude.value == pytest.approx(COULOMB, rel=0.1)
    assert found.found.discretisation_error == 0.0 and set(found.found.seconds) == {"preparation", *IN_BLOCKS}
    assert found.found.trends == [] and found.found.experiments == []
    assert not any(cell.found for cell in found.found.cells.before)
    before, after = (
        [(c.axis, c.joint, c.label, c.low, c.high) for c in cells]
        for cells in (found.found.cells.before, found.found.cells.after)
    )
    assert before == after  # also loads, of which each model has its own


def test_each_role_has_its_own_instants(found: Gap):
    clocks = [found.traces[role]["time"] for role in ("train", "validation", "test")]
    together = np.sort(np.concatenate(clocks))
    assert len(np.unique(together)) == len(together)
    assert np.ptp(np.diff(together)) < 1e-6  # nothing is left out
    assert clocks[2].min() > max(clocks[0].max(), clocks[1].max())
    names = [d.recording for d in found.found.discrepancies.values()]
    assert names == ["elbow, every other block", "elbow, the blocks between", "elbow, last third"]
    for role, size in found.found.discrepancies.items():
        traces = found.traces[role]
        np.testing.assert_array_equal(traces["scatter"], 0.0)
        for when in ("before", "after"):  # equation 1 holds the noise that the filter takes out of the traces
            left = np.abs(traces[when] - traces["measured"]).mean()
            assert left < getattr(size, f"torque_{when}") < 1.6 * left + 0.01
        assert size.after < 0.1 * size.before


@pytest.mark.slow
def test_what_a_log_lacks_is_handed_on(run: tuple[Path, str]):
    model = load_extended(run[0] / "extended.json", elbow())
    assert model.space.names[-1] == "joint_coulomb[elbow]" and model.lacking == ()
    assert np.all(np.isfinite(model.gaussian.cov)) and (run[0] / "extended.xml").is_file()


def test_the_page_of_a_log_claims_no_repeats(run: tuple[Path, str]):
    page = (run[0] / "report.html").read_text(encoding="utf-8").replace("\u00a0", " ")
    assert (
        "localisation cannot be distinguished from noise" in page
        and "noise included" in page
        and "less; the remaining U includes" in page
    )
    for untrue in (
        "repeats' mean",
        "one repeat's noise",
        "ten repeats",
        "Discretisation error U0",
        "whole repeats",
        "Hatched",
    ):
        assert untrue not in page, untrue
    ((roles, sealed), (turns, drawn)) = read_gap(run[0]).sheets
    assert (roles, turns) == (("test",), ("train", "validation"))
    assert np.all(np.diff(drawn["time"]) > 0) and drawn["time"][-1] < sealed["time"][0]


@pytest.mark.slow
def test_another_log_is_sealed(tmp_path: Path):
    other = replace(elbow_log(COULOMB, seconds=12.0), name="other")
    assert main(command(tmp_path, [LOG.window(0.0, 24.0), other], "--effects", "joint_coulomb", "cable_pull")) == 0
    sizes = read_gap(tmp_path / "run").found.discrepancies
    assert [d.recording for d in sizes.values()] == ["elbow, every other block", "elbow, the blocks between", "other"]
    assert sizes["test"].after < 0.1 * sizes["test"].before


# ----- one recording with repeats


@pytest.mark.slow
def test_the_second_half_of_the_repeats_confirms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(gap, "gap_config", lambda command: SEARCH)
    whole = elbow_log(COULOMB, seconds=12.0, repeats=16)
    assert main(command(tmp_path, [whole], "--effects", "joint_coulomb", "cable_pull")) == 0
    lines = capsys.readouterr().out.splitlines()[-7:]
    assert lines[0] == "The model lacks: joint_coulomb at elbow." and lines[4] == Split.REPEATS.limits
    answer = json.loads((tmp_path / "run" / "gap.json").read_text())
    assert answer["split"] == {"by": "repeats", "limits": Split.REPEATS.limits}
    names = {role: g["recording"] for role, g in answer["discrepancies"].items()}
    assert names == {"train": "elbow, first 8 repeats", "validation": "elbow, last 8 repeats"}
    assert answer["coefficients"][0]["value"] == pytest.approx(COULOMB, rel=0.05)
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "acts alike in this motion" in page and "No recording was kept as test data" in page
    assert "replayed without a time step" in page and "Discretisation error U0" not in page


@pytest.mark.slow
def test_a_late_repeat_of_the_second_half_keeps_its_number(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    whole = elbow_log(0.0, 6.0, repeats=16)
    position = whole.channel("position")
    values = position.values.copy()
    values[11] = np.roll(values[11], 30, axis=0)  # 100 Hz
    values[11, :30] = values[11, 30]
    late = replace(whole, channels={**whole.channels, "position": replace(position, values=values)})
    assert main(command(tmp_path, [late])) == 2
    assert "the only recording 'elbow': repeat 11 runs 0." in capsys.readouterr().err
