"""The command line: `python -m droid_jax.run --help`.

The commands are in `droid_jax.commands`.  They import heavy modules inside their functions, after `runtime.tune()`, so
that --help is quick.
"""

from __future__ import annotations

import os
import signal
import sys

if __name__ == "__main__":  # before the imports below, which take a while: Ctrl-C then causes no traceback
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, lambda *_: (os.write(2, b"interrupted\n"), os._exit(130)))
    from droid_jax.console import program

    sys.exit(program())

import contextlib
import dataclasses
import errno
import importlib.metadata
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from droid_jax import console, distributed
from droid_jax.commands import (
    all_stages,
    check,
    convert,
    evaluate,
    evaluate_fit,
    export,
    gap,
    identify,
    record,
    rehearse,
    report,
    train,
    view,
)
from droid_jax.commands.folder import BEGUN

Command = (
    Annotated[all_stages.All, tyro.conf.subcommand("all")]
    | identify.Identify
    | Annotated[gap.GapCommand, tyro.conf.subcommand("gap")]
    | train.Train
    | evaluate.Evaluate
    | evaluate_fit.EvaluateFit
    | export.Export
    | record.Record
    | convert.Convert
    | Annotated[check.CheckCommand, tyro.conf.subcommand("check")]
    | rehearse.Rehearse
    | report.Report
    | view.View
)
_ACTIONS: dict[type, Callable[[Any], None]] = {
    all_stages.All: all_stages.run,
    identify.Identify: identify.run,
    gap.GapCommand: gap.run,
    train.Train: train.run,
    evaluate.Evaluate: evaluate.run,
    evaluate_fit.EvaluateFit: evaluate_fit.run,
    export.Export: export.run,
    record.Record: record.run,
    convert.Convert: convert.run,
    check.CheckCommand: check.run,
    rehearse.Rehearse: rehearse.run,
    report.Report: report.run,
    view.View: view.run,
}


SCRIPT = "droid-jax"  # as pyproject.toml installs it
WHOLE = ("-h", "--help", "--tyro-")  # options of the program itself: help, shell completion
# Errors of the machine and not of the input: full disk, quota, file size limit, broken disk.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
RESUMED = (
    all_stages.All,
    identify.Identify,
    gap.GapCommand,
    train.Train,
    rehearse.Rehearse,
)  # commands that continue after a stop
SHARED = (all_stages.All, identify.Identify, gap.GapCommand)  # commands that several processes share
WHAT = """Fits a simulation to recordings of a robot, searches for missing effects, and trains a policy.

Without a command: `all`, on a synthetic robot.  --version prints the version."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command.  An error prints one line to stderr; the exit codes are those of `console`."""
    BEGUN.clear()
    given = _given(list(sys.argv[1:] if arguments is None else arguments))
    command: Any = None
    with console.stop_advice(lambda: _going_on(command)):
        try:
            if given == ["--version"]:
                print(f"droid_jax {importlib.metadata.version('droid_jax')}")
                return 0
            if _names_nothing(given, "--recording"):
                raise ValueError("--recording names no file; was it an empty shell variable?")
            script = Path(sys.argv[0]).name
            prog = script if script == SCRIPT else "python -m droid_jax.run"
            command = tyro.cli(Command, default=all_stages.All(), args=given, prog=prog, description=WHAT)
            with _plain_warnings():
                _check_seeds(command)
                if distributed.asked():
                    _run_together(command)
                else:
                    _ACTIONS[type(command)](command)
            return 0
        except SystemExit:  # --help, and options that do not exist
            raise
        except BaseException as error:
            if (code := _ended(error, command)) is None:
                if distributed.count() == 1:
                    raise
                traceback.print_exc()
            return distributed.leave(1 if code is None else code)


def _run_together(command: Any) -> None:
    """Run a command in several processes (`distributed`).

    A command that is not shared runs only in the first process, without connecting to the others: otherwise replays
    would wait for them, and brax would train on the devices of all.
    """
    from droid_jax import runtime

    if not isinstance(command, SHARED):
        if distributed.rank() == 0:
            _ACTIONS[type(command)](command)
        return
    if not distributed.count() > 1:
        runtime.tune()
        distributed.join()
    if isinstance(command, all_stages.All):
        all_stages.needs_one_process(command)
    with distributed.part(command.out) as folder:
        if (own := _own_part(command, folder)) is not None:
            _ACTIONS[type(own)](own)


def _own_part(command: Any, folder: Path | None) -> Any:
    """The part of a shared command that this process runs; None for nothing.

    The first process runs all of it, the others the stages that replay batches.
    """
    if distributed.first():
        return command
    if isinstance(command, all_stages.All):
        stages = tuple(stage for stage in command.stages if stage in all_stages.IN_A_SCENE)
        return dataclasses.replace(command, out=folder, stages=stages) if stages else None
    return dataclasses.replace(command, out=folder)


def _given(arguments: list[str]) -> list[str]:
    """The arguments, with the command `all` added if none is given."""
    if arguments == ["--version"] or (arguments and not arguments[0].startswith("-")):
        return arguments
    return arguments if arguments and arguments[0].startswith(WHOLE) else ["all", *arguments]


def _ended(error: BaseException, command: Any) -> int | None:
    """Print the error that ended a command and return the exit code; None for a bug of the program."""
    who = distributed.speaker()
    if isinstance(error, KeyboardInterrupt):  # only if another program calls main; otherwise `console` handles it
        print(console.stop_message(signal.SIGINT), file=sys.stderr)
        return 128 + signal.SIGINT
    if isinstance(error, BrokenPipeError) and console.reader_gone():
        console.drop_output()
        if command is None:  # --help | head is no error
            return 0
        if how := _going_on(command):  # other commands stop silently, as in a shell
            print(f"stopped: the output is no longer read{how}", file=sys.stderr)
        return console.CLOSED
    if isinstance(error, OSError) and error.errno in FULL:
        place = f"{error.filename}: " if error.filename else "what was to be written: "
        print(f"{who}error: {place}{(error.strerror or str(error)).lower()}{_going_on(command)}", file=sys.stderr)
        return 1
    if isinstance(error, MemoryError):
        print(f"{who}error: out of memory{_going_on(command)}", file=sys.stderr)
        return 1
    if isinstance(error, (ValueError, OSError)):
        print(f"{who}error: {_one_sentence(error)}", file=sys.stderr)
        return 2
    if isinstance(error, distributed.Lost):
        print(f"{who}error: {error}", file=sys.stderr)
        return 1
    return None


def _one_sentence(error: Exception) -> str:
    """An error's text; for file system errors the file and the reason, without the number."""
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror[:1].lower()}{error.strerror[1:]}"
    return str(error)


def _check_seeds(command: Any) -> None:
    """ValueError for a negative seed, with a clearer message than numpy's."""
    for name in ("seed", "robot"):  # of the random draws, and of the synthetic robot
        if (value := getattr(command, name, None)) is not None and value < 0:
            raise ValueError(f"--{name} must not be negative, got {value}")


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print a UserWarning in one line, without its place in the code."""
    usual = warnings.formatwarning

    def plain(message: Any, category: type[Warning], *place: Any, **more: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else usual(message, category, *place, **more)

    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _names_nothing(arguments: Sequence[str], option: str) -> bool:
    """Whether an option is given without values, which would otherwise count as not given."""
    if option not in arguments:
        return False
    behind = [*arguments, "-"][list(arguments).index(option) + 1]
    return not behind or behind.startswith("-")


def _going_on(command: Any) -> str:
    """How to continue an interrupted command; empty if that is not possible."""
    if not isinstance(command, RESUMED):
        return ""
    how = "the same command without --again" if getattr(command, "again", False) and BEGUN else "the same command"
    return f"; {how} goes on from here"
