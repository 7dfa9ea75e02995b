"""The program as a shell command, in separate processes: streams, signals, exit codes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from droid_jax import run
from droid_jax.commands import convert
from droid_jax.door.demonstration import demonstration_path
from droid_jax.recordings.formats import load_recording
from droid_jax.run import main

ROOT = Path(__file__).resolve().parents[1]
RUN = [sys.executable, "-m", "droid_jax.run"]
LOG = str(demonstration_path("A"))


def shell(script: str, **options) -> subprocess.CompletedProcess[str]:
    """Run a script in which `droid-jax` is this program."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("env", {})}
    script = script.replace("droid-jax", f"{sys.executable} -m droid_jax.run")
    return subprocess.run(
        ["bash", "-c", script], env=environment, capture_output=True, text=True, timeout=120, **options
    )


# ----- streams


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&- <&-"])
def test_closed_streams_lead_nowhere(tmp_path: Path, closed: str):
    """A file that is opened later must not be taken for the standard output."""
    done = shell(f"droid-jax convert {LOG} --out log.npz {closed}", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert [p.name for p in tmp_path.iterdir()] == ["log.npz"]
    assert load_recording(tmp_path / "log.npz").name == "A"


def test_an_error_with_a_closed_output(tmp_path: Path):
    done = shell("droid-jax report nothing >&-", cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith("error: ") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", ["--version", "--help", f"convert {LOG} --out log.npz"])
def test_a_pipe_that_nobody_reads(tmp_path: Path, arguments: str):
    """The run is done although the reader of its last line is gone."""
    done = shell(f"set -o pipefail; droid-jax {arguments} | true", cwd=tmp_path)
    assert done.stderr == "" and done.returncode in (0, 141)


def test_a_run_that_nobody_listens_to_any_more_is_stopped(monkeypatch, capfd, tmp_path: Path):
    """At its next output, as a shell expects."""
    script = (
        "import sys\nfrom droid_jax import run, console\nfrom droid_jax.commands import identify\n"
        "def talk(command):\n    for _ in range(100000):\n        print('cost', flush=True)\n    raise ValueError\n"
        "run._ACTIONS[identify.Identify] = talk\nsys.argv = ['droid-jax', 'identify']\nsys.exit(console.program())\n"
    )
    (tmp_path / "talk.py").write_text(script)
    done = shell(f"set -o pipefail; {sys.executable} talk.py | head -n 1", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (141, "cost\n")
    assert done.stderr == "stopped: the output is no longer read; the same command goes on from here\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_output_on_a_full_disk():
    done = shell("droid-jax --version > /dev/full", env={"PYTHONUNBUFFERED": ""})
    assert done.returncode == 1
    assert done.stderr == "error: the output cannot be written: no space left on device\n"


# ----- disks


def test_a_disk_that_is_full(tmp_path: Path):
    """Files may not exceed 4 kB: existing files stay complete, and no others are left."""

    (tmp_path / "log.npz").write_bytes(Path(LOG).read_bytes())
    done = shell(f"trap '' XFSZ; ulimit -f 4; droid-jax convert {LOG} --out log.npz", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (1, "error: log.npz: file too large\n")
    assert [p.name for p in tmp_path.iterdir()] == ["log.npz"]
    assert (tmp_path / "log.npz").read_bytes() == Path(LOG).read_bytes()


def test_a_full_disk_in_a_run_says_how_it_goes_on(monkeypatch, capsys, tmp_path: Path):
    def full(command: object) -> None:
        raise OSError(28, "No space left on device", "run/fit.json")

    monkeypatch.setattr(run, "_ACTIONS", dict.fromkeys(run._ACTIONS, full))
    assert main(["identify"]) == 1
    assert capsys.readouterr().err == (
        "error: run/fit.json: no space left on device; the same command goes on from here\n"
    )


def test_a_checkpoint_on_a_full_disk_names_it(tmp_path: Path):
    script = (
        "import resource, signal, numpy as np\n"
        "from droid_jax.identify.checkpoints import Checkpoints\n"
        f"with Checkpoints({str(tmp_path)!r}) as kept:\n"
        "    kept.save(1, {'a': np.random.default_rng(0).normal(size=1000)})\n"
        "    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "    try:\n        kept.save(2, {'a': np.random.default_rng(0).normal(size=100000)})\n"
        "    except OSError as error:\n        print(error.filename, '|', error.strerror.splitlines()[0])\n"
        "with Checkpoints('%s') as kept:\n    print(kept.restore()[0])\n" % tmp_path
    )
    done = shell(f"{sys.executable} -", input=script)
    first, second = done.stdout.splitlines()
    assert first.startswith(f"{tmp_path / '2'} | the checkpoint cannot be written: "), done.stderr
    assert second == "1"  # and the one before is whole


# ----- signals


def caught(process: int) -> int:
    """Signals that a process handles, as bits."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt")), 16)


def stopped(after: float, number: int, *arguments: str, cwd: Path) -> tuple[int, str]:
    """Exit code and stderr of a command that is sent a signal some seconds after it listens to signals."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [*RUN, *arguments],
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # these tests may run in the background
    ) as process:
        while process.poll() is None and not caught(process.pid) >> (signal.SIGTERM - 1) & 1:
            time.sleep(0.01)
        time.sleep(after)
        process.send_signal(number)
        _, said = process.communicate(timeout=60)
    return process.returncode, said


@pytest.mark.parametrize(
    ("after", "number", "code", "word"),
    [
        (0.0, signal.SIGINT, 130, "interrupted"),
        (0.2, signal.SIGTERM, 143, "terminated"),
        (0.5, signal.SIGINT, 130, "interrupted"),
        (0.8, signal.SIGTERM, 143, "terminated"),  # a quick machine has begun after 2 s
    ],
)
def test_a_stop_while_everything_is_imported(tmp_path: Path, after: float, number: int, code: int, word: str):
    """One line, whichever import it hits, and no folder."""
    ended, said = stopped(after, number, "identify", "--out", "run", cwd=tmp_path)
    assert ended == code and said.count("\n") == 1 and said.startswith(word), said
    assert not (tmp_path / "run").exists()


def test_a_signal_that_was_ignored_from_outside_stays_so(tmp_path: Path):
    """As nohup does, and a shell for jobs in the background."""
    done = shell(f"trap '' INT; droid-jax convert {LOG} --out log.npz & sleep 0.5; kill -INT $!; wait $!", cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / "log.npz").exists(), done.stderr


def test_code_that_holds_a_signal_back_does_not_keep_the_program_alive(tmp_path: Path):
    """Like a compiler that runs for minutes; the program still tidies up."""
    script = (
        "import sys, ctypes, pathlib\nfrom droid_jax import run, console\nfrom droid_jax.commands import identify\n"
        "def hold(command):\n"
        "    with console.at_the_end(pathlib.Path('tidy').touch):\n        print('holding', flush=True)\n"
        "        ctypes.CDLL(None).usleep(30_000_000)\n        ctypes.CDLL(None).usleep(30_000_000)\n"
        "run._ACTIONS[identify.Identify] = hold\nsys.argv = ['droid-jax', 'identify']\nsys.exit(console.program())\n"
    )
    (tmp_path / "hold.py").write_text(script)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "hold.py"],
        cwd=tmp_path,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "holding\n"
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=20)
    assert (process.returncode, said) == (143, "terminated; the same command goes on from here\n")
    assert (tmp_path / "tidy").exists()


# ----- what a machine may lack


@pytest.mark.parametrize(
    "lacking",
    [{"HOME": "/dev/null"}, {"HOME": ""}, {"XDG_CACHE_HOME": "/dev/null/cache"}, {"TMPDIR": "/nonexistent"}],
)
def test_without_a_home_a_cache_or_a_folder_for_temporary_files(tmp_path: Path, lacking: dict[str, str]):
    """A run goes on, with one line where that makes it slower."""
    script = (
        "import os\nfrom droid_jax import runtime\nos.environ.pop('DROID_JAX_CACHE', None)\n"
        "print(runtime._cache_root(None))"
    )
    done = shell(f"{sys.executable} -", input=script, cwd=tmp_path, env=lacking)
    assert done.returncode == 0, done.stderr
    told = [line for line in done.stderr.splitlines() if "UserWarning" in line]
    if lacking.get("HOME") == "/dev/null" or "XDG_CACHE_HOME" in lacking:
        assert len(told) == 1 and "working without a compilation cache" in told[0] and "DROID_JAX_CACHE" in told[0]
    else:
        assert told == []


def test_a_home_that_nobody_knows(monkeypatch: pytest.MonkeyPatch):
    """A user without an entry in the system's list and without the variable: a container with another number."""
    from droid_jax import runtime

    def nobody(self: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "expanduser", nobody)
    for name in ("DROID_JAX_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    with pytest.warns(UserWarning, match="working without a compilation cache.*home directory"):
        assert runtime._cache_root(None) is None


def test_a_chosen_cache_that_cannot_be_written_is_an_error(refused: Callable[..., str], monkeypatch, tmp_path: Path):
    from droid_jax import runtime

    monkeypatch.setenv(runtime.CACHE_VARIABLE, "/dev/null/cache")

    def tuned(command: object) -> None:
        runtime._cache_root(None)

    monkeypatch.setitem(run._ACTIONS, convert.Convert, tuned)
    assert "the cache folder /dev/null/cache cannot be written" in refused("convert", "x")
