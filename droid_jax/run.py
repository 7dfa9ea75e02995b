"""The command line: parses, calls, writes.  `python -m droid_jax.run --help`

The commands are in `droid_jax.commands`; heavy modules are imported inside them, after `runtime.tune()`
and so that --help is quick.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from droid_jax.commands import convert, evaluate, export, gap, identify, record, report, train, view, whole
from droid_jax.commands.folder import BEGUN

Command = (
    Annotated[whole.All, tyro.conf.subcommand("all")]
    | identify.Identify
    | gap.Gap
    | train.Train
    | evaluate.Evaluate
    | export.Export
    | record.Record
    | convert.Convert
    | report.Report
    | view.View
)
_ACTIONS: dict[type, Callable[[Any], None]] = {
    whole.All: whole.run,
    identify.Identify: identify.run,
    gap.Gap: gap.run,
    train.Train: train.run,
    evaluate.Evaluate: evaluate.run,
    export.Export: export.run,
    record.Record: record.run,
    convert.Convert: convert.run,
    report.Report: report.run,
    view.View: view.run,
}


SCRIPT = "droid-jax"  # as pyproject.toml installs it
WHOLE = ("-h", "--help", "--tyro-")  # options of the program itself: help, shell completion
RESUMED = (whole.All, identify.Identify, gap.Gap, train.Train)  # commands that go on where they were stopped
WHAT = """From recordings of a robot to a fitted simulation, to what that simulation lacks, and to a policy.

Without a command: `all`, on a stand-in robot.  --version says which version this is."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; bad input ends with one line on stderr and exit code 2."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if arguments == ["--version"]:
        print(f"droid_jax {importlib.metadata.version('droid_jax')}")
        return 0
    if not arguments or (arguments[0].startswith("-") and not arguments[0].startswith(WHOLE)):
        arguments = ["all", *arguments]
    if _names_nothing(arguments, "--recording"):
        print("error: --recording names no file; was it an empty shell variable?", file=sys.stderr)
        return 2
    script = Path(sys.argv[0]).name
    prog = script if script == SCRIPT else "python -m droid_jax.run"
    try:
        command = tyro.cli(Command, default=whole.All(), args=arguments, prog=prog, description=WHAT)
    except BrokenPipeError:  # --help | head: nobody reads on, which is no error
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is flushed at the end
        return 0
    try:
        with _plain_warnings():
            _check_seeds(command)
            _ACTIONS[type(command)](command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted{_going_on(command)}", file=sys.stderr)
        return 130
    return 0


def _check_seeds(command: Any) -> None:
    """ValueError for a negative seed, of which numpy's generators say less."""
    for name in ("seed", "robot"):  # of what is drawn, and of the stand-in robot
        if (value := getattr(command, name, None)) is not None and value < 0:
            raise ValueError(f"--{name} must not be negative, got {value}")


@contextlib.contextmanager
def _plain_warnings() -> Iterator[None]:
    """Warnings for people (UserWarning) in one line without the place in the code that gave them."""
    usual = warnings.formatwarning

    def plain(message: Any, category: type[Warning], *place: Any, **more: Any) -> str:
        return f"warning: {message}\n" if category is UserWarning else usual(message, category, *place, **more)

    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _names_nothing(arguments: Sequence[str], option: str) -> bool:
    """Whether an option stands there without values, which would be the same as leaving it away."""
    if option not in arguments:
        return False
    behind = [*arguments, "-"][list(arguments).index(option) + 1]
    return not behind or behind.startswith("-")


def _going_on(command: Any) -> str:
    """How an interrupted command goes on, where it can."""
    if not isinstance(command, RESUMED):
        return ""
    how = "the same command without --again" if command.again and BEGUN else "the same command"
    return f"; {how} goes on from here"


if __name__ == "__main__":
    sys.exit(main())
