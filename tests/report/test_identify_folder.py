"""Files of an identification that are missing or damaged are named, with what to do."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from made_up_run import make_run

from droid_jax.report import page
from droid_jax.report.identify_folder import read_run


@pytest.mark.parametrize("name", ["config.json", "fit.json", "history.npz", "traces.npz", "correlation.npz"])
@pytest.mark.parametrize("content", [None, b"", b"{broken"])
def test_a_required_file_that_is_missing_or_broken_is_named(tmp_path: Path, name: str, content: bytes | None) -> None:
    run = make_run(tmp_path / "run")
    (run / name).unlink()
    if content is not None:
        (run / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{re.escape(name)}.*droid_jax\.run identify"):
        page.write_report(run)
    assert not (run / "report.html").exists()


def test_a_missing_key_and_a_wrong_shape_are_named(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    del fit["parameters"][2]["truth"]
    (run / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(ValueError, match=r"fit\.json: 'parameters', entry 2 lacks 'truth'; run .*identify"):
        read_run(run)
    run = make_run(tmp_path / "other")
    arrays = dict(np.load(run / "traces.npz"))
    arrays["open_close/after"] = arrays["open_close/after"][:-1]
    np.savez(run / "traces.npz", **arrays)
    with pytest.raises(ValueError, match=r"open_close/after must be .*\(3840, 7\).*\(3839, 7\); run .*identify"):
        read_run(run)


def test_a_name_too_long_to_draw_is_refused(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    arrays = dict(np.load(run / "traces.npz"))
    arrays["open_close/joints"] = np.array(["y" * 100_000, *arrays["open_close/joints"][1:]])
    np.savez(run / "traces.npz", **arrays)
    with pytest.raises(ValueError, match=r"holds a name of 100000 characters, at most 200 are read; run .*identify"):
        read_run(run)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda fit: fit.update(parameters=-0.0), r"fit\.json: 'parameters' must be a list, got -0\.0"),
        (lambda fit: fit.update(parameters=[]), r"fit\.json, 'parameters' is empty"),
        (lambda fit: fit.update(heldout_distances={}), r"fit\.json, 'heldout_distances' is empty"),
        (
            lambda fit: fit["heldout_distances"].update(other=fit["heldout_distances"].pop("open_close")),
            "of which fit.json has no 'heldout_distances'",
        ),
        (lambda fit: fit["heldout_distances"]["open_close"].update(judged="x"), "'judged' must be one of"),
        (lambda fit: fit["cost"].pop("best"), "'cost' lacks 'best'"),
        (
            lambda fit: fit["heldout_distances"].update(open_close=0.1),
            r"'heldout_distances', 'open_close' must be an object, got 0\.1",
        ),
        (lambda fit: fit["parameters"][2].update(initial_mean=10**400), r"a whole number beyond 2\^63"),
        (lambda fit: fit["parameters"][2].update(low=float("inf")), "Infinity is no number of JSON"),
        (lambda fit: fit["parameters"][2].update(name="a\0"), r"U\+0000"),
        (lambda fit: fit["parameters"].append(fit["parameters"][0]), "holds hinge_stiffness more than once"),
        (lambda fit: fit["parameters"][0].update(interval=[1.0]), "'interval' must be a list of length 2"),
        (lambda fit: fit.update(notes="cold"), "'notes' must be a list, got 'cold'"),
    ],
)
def test_a_damaged_fit_is_one_sentence(tmp_path: Path, change, said: str) -> None:
    run = make_run(tmp_path / "run")
    fit = json.loads((run / "fit.json").read_text())
    change(fit)
    (run / "fit.json").write_text(json.dumps(fit))
    with pytest.raises(ValueError, match=said) as caught:
        page.write_report(run)
    assert "fit.json" in str(caught.value) and "run identify` again" in str(caught.value)
