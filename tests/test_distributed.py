"""A run of several processes: the same numbers, one writer, and an end where one of them is lost."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.distributed import ROOT, SEARCH, finish, largest_difference, largest_shift, lose
from droid_jax import distributed, run
from droid_jax.commands.all_stages import All, needs_one_process

PART = """
import json, os, sys
from pathlib import Path
from droid_jax import distributed, runtime
runtime.tune(devices=2)
distributed.join()
import numpy as np
def rows(values):
    return {"double": values.sum(1) / 3, "pair": np.float32(values[:, :2]), "large": values[:, 0] > 2.5,
            "count": np.full(len(values), len(values))}
values = np.arange(15.0).reshape(5, 3)
found = distributed.over_processes(rows, values)
seen = {name: a.tolist() for name, a in found.items()} | {"types": {n: str(a.dtype) for n, a in found.items()}}
seen["agreed"] = distributed.agreed(distributed.index() == 0)
out, result = Path(sys.argv[1]), Path(sys.argv[2])
with distributed.part(out) as folder:
    print("in process", distributed.index(), flush=True)
    seen |= {"own": folder == out, "files": sorted(p.name for p in folder.rglob("*"))}
    seen["text"] = (folder / "inner" / "kept.txt").read_text()
    (folder / f"by{distributed.index()}.txt").write_text("-")
    result.with_name(f"{result.name}.{distributed.index()}").write_text(json.dumps(seen))
seen["gone"] = folder.exists()
try:
    distributed.over_processes(rows, values + distributed.index())
except RuntimeError as error:
    print(error, file=sys.stderr)
"""


def test_two_processes_share_rows_decisions_and_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "run"
    (out / "inner").mkdir(parents=True)
    (out / "inner" / "kept.txt").write_text("kept")
    (out / "report.html").write_text("not needed")
    environment = {
        **{k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")},
        **{"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", distributed.COORDINATOR: f"localhost:{free_port()}"},
        distributed.COUNT: "2",
    }
    command = [sys.executable, "-c", PART, str(out), str(tmp_path / "seen")]
    both = [
        subprocess.Popen(
            command,
            env={**environment, distributed.INDEX: str(n)},
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for n in range(2)
    ]
    said = [process.communicate(timeout=120) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    first, second = (json.loads((tmp_path / f"seen.{n}").read_text()) for n in range(2))
    assert first.pop("own") and not second.pop("own")
    assert "report.html" in first.pop("files") and second.pop("files") == ["inner", "kept.txt"]
    assert first == second
    values = np.arange(15.0).reshape(5, 3)
    assert first["double"] == (values.sum(1) / 3).tolist()  # to the last bit, of doubles too
    assert first["pair"] == values[:, :2].tolist() and first["large"] == (values[:, 0] > 2.5).tolist()
    assert first["count"] == [3] * 5  # rows of each: the fifth twice
    assert first["types"] == {"count": "int64", "double": "float64", "large": "bool", "pair": "float32"}
    assert first["agreed"] and first["text"] == "kept"
    assert (out / "by0.txt").is_file() and not (out / "by1.txt").exists()
    assert [text for text, _ in said] == ["in process 0\n", ""]
    assert all("no longer ask for the same replays" in error for _, error in said)


def free_port() -> int:
    import socket

    with socket.socket() as free:
        free.bind(("localhost", 0))
        return free.getsockname()[1]


def test_one_process_needs_no_jax_and_no_copy(tmp_path: Path) -> None:
    values = np.ones((3, 2))
    assert distributed.over_processes(lambda rows: rows, values) is values
    assert distributed.agreed(True) and not distributed.agreed(False)
    with distributed.part(tmp_path) as folder:
        assert folder == tmp_path
    assert distributed.leave(2) == 2 and distributed.speaker() == ""


@pytest.mark.parametrize(("text", "on"), [("1", True), ("true", True), ("0", False), ("", False), ("no", False)])
def test_the_environment_asks(monkeypatch: pytest.MonkeyPatch, text: str, on: bool) -> None:
    monkeypatch.setenv(distributed.VARIABLE, text)
    assert distributed.asked() is on


def test_a_number_that_is_none_is_told(refused, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(distributed.VARIABLE, "1")
    monkeypatch.setenv(distributed.INDEX, "two")
    assert "JAX_PROCESS_ID must be a whole number, got 'two'" in refused("identify", "--scene", "nothing.xml")


@pytest.mark.parametrize("launcher", distributed.RANKS)
@pytest.mark.parametrize("arguments", ["train", "rehearse", "evaluate-fit --recording a.npz"])
def test_what_is_not_shared_is_done_by_the_first_process_alone(monkeypatch, launcher: str, arguments: str) -> None:
    """Regression: it connected to the others, which did nothing, so that brax and shared replays failed or hung."""
    did = list[str]()
    actions = dict.fromkeys(run._ACTIONS, lambda command: did.append(os.environ[launcher]))
    monkeypatch.setattr(run, "_ACTIONS", actions)
    monkeypatch.setattr(distributed, "join", lambda: pytest.fail("it waits for the other processes"))
    monkeypatch.setenv(distributed.VARIABLE, "1")
    for name in distributed.RANKS:
        monkeypatch.delenv(name, raising=False)
    for number in "01":
        monkeypatch.setenv(launcher, number)
        assert run.main(arguments.split()) == 0
    assert did == ["0"]


def test_several_processes_do_not_train(monkeypatch: pytest.MonkeyPatch) -> None:
    """Regression: brax hung or failed after hours of search."""
    needs_one_process(All())  # of one
    monkeypatch.setattr(distributed, "_place", [0, 2])
    with pytest.raises(ValueError, match="give --stages identify gap, then train in one process"):
        needs_one_process(All())
    needs_one_process(All(stages=("identify", "gap")))
    needs_one_process(All(scene=Path("own.xml")))  # in which none is trained


@pytest.mark.slow
def test_the_same_fit_in_several_processes_and_after_a_kill(tmp_path: Path) -> None:
    words = [*SEARCH, "--population", "32", "--generations", "12"]
    finish(1, [*words, "--out", str(tmp_path / "one")], tmp_path)
    for name, count in (("two", 2), ("four", 4)):
        finish(count, [*words, "--out", str(tmp_path / name)], tmp_path)
        assert largest_difference(tmp_path / "one", tmp_path / name) < 1e-5, name
    finish(1, [*words, "--out", str(tmp_path / "devices")], tmp_path, devices=4)  # rounded otherwise
    assert largest_shift(tmp_path / "one", tmp_path / "devices") < 0.2
    killed = tmp_path / "killed"
    lost = lose([*words, "--out", str(killed)], killed, tmp_path, 0, signal.SIGKILL)
    assert lost["seconds"] < 30 and lost["code"] == 1
    assert "another process of this run ended" in lost["said"] and "goes on from its last checkpoint" in lost["said"]
    finish(1, [*words, "--out", str(killed)], tmp_path)
    assert largest_difference(tmp_path / "one", killed) < 1e-5


@pytest.mark.slow
def test_a_process_that_no_longer_answers_ends_the_run(tmp_path: Path) -> None:
    words = [*SEARCH, "--population", "32", "--generations", "100", "--out", str(tmp_path / "run")]
    lost = lose(words, tmp_path / "run", tmp_path, 0, signal.SIGSTOP)
    assert lost["seconds"] < 30 and lost["code"] != 0
    assert "was lost" in lost["said"]


def test_the_documents_and_the_manifest_name_the_variables() -> None:
    for document in ("docs/scale.md", "docs/examples/jobset.yaml"):
        text = (ROOT / document).read_text()
        for name in (distributed.VARIABLE, distributed.COORDINATOR, distributed.COUNT, distributed.INDEX):
            assert name in text, (document, name)
    assert f"given up after {distributed.HEARTBEAT} s" in (ROOT / "docs/scale.md").read_text()
