"""One writer to a results folder, and nothing replaced that this program did not write."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from droid_jax.commands.writer import InUse, one_writer
from droid_jax.door.demonstration import demonstration_path
from droid_jax.files import LOCK
from droid_jax.run import main
from droid_jax.storage import new_folder, write_bytes, write_own

ROOT = Path(__file__).resolve().parents[1]
LOG = demonstration_path("A")
HOLD = (
    "import sys, pathlib, time\nfrom droid_jax.commands.writer import one_writer\n"
    "with one_writer(pathlib.Path(sys.argv[1]), 'identify'):\n    print('held', flush=True)\n    time.sleep(60)\n"
)


@pytest.fixture
def holder(tmp_path: Path):
    """Starts a process that writes to a folder."""
    begun: list[subprocess.Popen[str]] = []

    def start(folder: Path) -> subprocess.Popen[str]:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(folder)], env=environment, stdout=subprocess.PIPE, text=True
        )
        begun.append(process)
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        return process

    yield start
    for process in begun:
        process.kill()
        process.wait()


# ----- one writer


@pytest.mark.parametrize("command", ["identify", "gap", "train", "all"])
def test_a_second_run_is_refused_at_once(refused: Callable[..., str], holder, tmp_path: Path, command: str):
    process = holder(tmp_path / "run")
    said = refused(command, "--out", tmp_path / "run")
    assert said == (
        f"error: another run writes to {tmp_path / 'run'} (process {process.pid}): wait until it ends, or choose "
        "another --out"
    )


def test_a_stage_of_all_is_refused_beside_it(refused: Callable[..., str], holder, tmp_path: Path):
    holder(tmp_path / "run")
    assert f"another run writes to {tmp_path / 'run'} " in refused("identify", "--out", tmp_path / "run" / "identify")


def test_reading_needs_no_lock(refused: Callable[..., str], holder, tmp_path: Path):
    holder(tmp_path / "run")
    assert "config.json is missing" in refused("report", tmp_path / "run")


def test_a_killed_run_leaves_its_folder_free(holder, tmp_path: Path):
    process = holder(tmp_path / "run")
    process.kill()
    process.wait()
    assert (tmp_path / "run" / LOCK).exists()  # nobody holds it
    with one_writer(tmp_path / "run", "identify"):
        (tmp_path / "run" / "setup.json").write_text("{}")
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["setup.json"]


def test_a_run_holds_its_own_folder_twice(tmp_path: Path):
    """`all` and its stages."""
    with (
        one_writer(tmp_path / "run", "all"),
        one_writer(tmp_path / "run", "all"),
        one_writer(tmp_path / "run" / "identify", "identify"),
    ):
        assert (tmp_path / "run" / LOCK).exists()
    assert not (tmp_path / "run").exists()


def test_the_lock_is_free_behind_an_error(tmp_path: Path):
    (tmp_path / "kept").mkdir()
    with pytest.raises(RuntimeError), one_writer(tmp_path / "kept", "gap"):
        raise RuntimeError
    with one_writer(tmp_path / "kept", "gap"):
        pass
    assert list((tmp_path / "kept").iterdir()) == []


def test_the_lock_of_another_process_is_an_input_error():
    assert issubclass(InUse, ValueError)


# ----- nothing of others is replaced

SPECIAL = {
    "device": lambda path: path.symlink_to("/dev/null"),
    "pipe": os.mkfifo,
    "socket": lambda path: socket.socket(socket.AF_UNIX).bind(str(path)),
    "dangling": lambda path: path.symlink_to("nowhere"),
    "loop": lambda path: path.symlink_to(path.name),
}


@pytest.mark.parametrize("kind", SPECIAL)
@pytest.mark.parametrize("suffix", ["", ".npz"])
@pytest.mark.parametrize("command", [("convert", str(LOG)), ("record",)])
def test_what_is_no_file_and_no_folder_stays(
    refused: Callable[..., str], monkeypatch, tmp_path: Path, command: tuple[str, ...], suffix: str, kind: str
):
    monkeypatch.chdir(tmp_path)  # a socket's name is short
    target = Path(f"out{suffix}")
    SPECIAL[kind](target)
    before = os.lstat(target)
    said = refused(*command, "--out", target)
    assert f"out{suffix} is a " in said and "not replaced" in said
    assert os.lstat(target) == before and len(list(tmp_path.iterdir())) == 1


def test_a_device_itself_stays(refused: Callable[..., str]):
    for command in (("convert", str(LOG)), ("record",)):
        said = refused(*command, "--out", "/dev/null")
        assert "/dev/null is a device, where a folder is to be written" in said
    for command in ("identify", "gap", "train", "all"):
        assert "the results folder /dev/null cannot be written" in refused(command, "--out", "/dev/null")
    assert Path("/dev/null").is_char_device()


def foreign_npz(path: Path) -> None:
    np.savez(path, format=np.array("my own"), data=np.ones(3))


@pytest.mark.parametrize(
    "write", [foreign_npz, lambda p: p.write_bytes(b""), lambda p: p.write_text("mine"), Path.mkdir]
)
def test_a_file_of_somebody_else_stays(refused: Callable[..., str], tmp_path: Path, write: Callable[[Path], object]):
    path = tmp_path / "log.npz"
    write(path)
    before = path.read_bytes() if path.is_file() else None
    for command in (("convert", str(LOG)), ("record",)):
        assert "not replaced" in refused(*command, "--out", path)
    assert (path.read_bytes() if path.is_file() else None) == before


def test_a_recording_is_replaced_and_so_is_a_damaged_one(tuned, tmp_path: Path):
    path = tmp_path / "log.npz"
    for damage in (None, 1000):
        assert main(["convert", str(LOG), "--out", str(path)]) == 0
        path.write_bytes(path.read_bytes()[:damage])
    assert main(["convert", str(LOG), "--out", str(path)]) == 0


@pytest.mark.parametrize("name", ["notes.txt", "recording.json"])
def test_a_folder_of_somebody_else_stays(refused: Callable[..., str], tmp_path: Path, name: str):
    folder = tmp_path / "log"
    folder.mkdir()
    (folder / name).write_text("mine")
    refused("convert", LOG, "--out", folder)
    assert [p.read_text() for p in folder.iterdir()] == ["mine"]


def test_a_link_to_a_folder_is_not_replaced(tuned, refused: Callable[..., str], tmp_path: Path):
    assert main(["convert", str(LOG), "--out", str(tmp_path / "log")]) == 0
    (tmp_path / "link").symlink_to("log")
    assert "link is a symbolic link" in refused("convert", LOG, "--out", tmp_path / "link")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "log" / "recording.json").exists()


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("identify", "config.json"),
        ("identify", "figures/mine.png"),
        ("identify", "report.html"),
        ("gap", "gap.json"),
        ("gap", "checkpoints/1"),
        ("gap", "recordings/A.npz"),
        ("train", "policy.npz"),
        ("all", "all.json"),
    ],
)
@pytest.mark.parametrize("option", [(), ("--again",)])
def test_results_of_somebody_else_stay(
    refused: Callable[..., str], tmp_path: Path, command: str, name: str, option: tuple[str, ...]
):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text('{"mine": 1}')
    said = refused(command, "--out", tmp_path, *option)
    first = name if name.startswith("recordings") else name.split("/")[0]
    assert said.startswith(f"error: {tmp_path} holds {first}, and no run of this program: it is not replaced")
    assert (tmp_path / name).read_text() == '{"mine": 1}'
    assert {p.name for p in tmp_path.iterdir()} == {name.split("/")[0]}


def test_files_beside_a_run_do_not_hinder_it(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "recordings").mkdir()
    shutil.copy(LOG, tmp_path / "recordings" / "monday.npz")
    with one_writer(tmp_path, "identify"):
        pass
    assert {p.name for p in tmp_path.iterdir()} == {"notes.txt", "recordings"}


def test_a_page_of_somebody_else_stays(tmp_path: Path):
    from droid_jax.report.page import _is_page

    (tmp_path / "report.html").write_text("<html><title>My own</title></html>")
    assert not _is_page(tmp_path / "report.html")
    template = (ROOT / "droid_jax" / "report" / "templates" / "page.html.jinja").read_text()
    (tmp_path / "report.html").write_text(template[template.index("<!DOCTYPE") :])
    assert _is_page(tmp_path / "report.html")


def test_what_was_exported_and_then_changed_stays(tmp_path: Path):
    """The control loop for a robot's computer is meant to be changed by the user."""
    write_own(tmp_path / "out", {"control.py": b"one", "policy.npz": b"1"})
    write_own(tmp_path / "out", {"control.py": b"two", "policy.npz": b"2"})
    (tmp_path / "out" / "control.py").write_bytes(b"mine")
    with pytest.raises(ValueError, match=r"control\.py was not written by this program, or was changed since"):
        write_own(tmp_path / "out", {"control.py": b"three", "policy.npz": b"3"})
    assert (tmp_path / "out" / "control.py").read_bytes() == b"mine"
    assert (tmp_path / "out" / "policy.npz").read_bytes() == b"2"


def test_an_export_that_was_stopped_goes_on(tmp_path: Path, monkeypatch):
    write_own(tmp_path, {"a": b"one", "b": b"one"})
    with monkeypatch.context() as patched:
        patched.setattr("droid_jax.storage.write_bytes", failing_at(2))
        with pytest.raises(OSError, match="full"):
            write_own(tmp_path, {"a": b"two", "b": b"two"})
    write_own(tmp_path, {"a": b"three", "b": b"three"})
    assert {p.read_bytes() for p in (tmp_path / "a", tmp_path / "b")} == {b"three"}


def failing_at(call: int) -> Callable[[Path, bytes], None]:
    """`write_bytes` whose call of this number, from 0, fails."""
    calls: list[Path] = []

    def write(path: Path, content: bytes) -> None:
        calls.append(path)
        if len(calls) == call + 1:
            raise OSError(28, "full")
        write_bytes(path, content)

    return write


@pytest.mark.parametrize("kind", SPECIAL)
def test_the_rule_holds_for_every_file_and_folder(monkeypatch, tmp_path: Path, kind: str):
    monkeypatch.chdir(tmp_path)
    SPECIAL[kind](Path("it"))
    with pytest.raises(ValueError, match=r"it is a .*, where a file is to be written"):
        write_bytes(Path("it"), b"")
    with pytest.raises(ValueError, match=r"it is a .*, where a folder is to be written"), new_folder(Path("it")):
        pass
    assert os.listdir() == ["it"]
