"""`evaluate-fit`: errors of a finished fit on other recordings, in physical units."""

from __future__ import annotations

import datetime
from dataclasses import asdict, dataclass
from pathlib import Path

from droid_jax.commands import report
from droid_jax.commands.fitted import fitted_folder, load_fitted
from droid_jax.commands.options import load_effects, recording_at
from droid_jax.commands.writer import writes
from droid_jax.files import EVALUATION, EVALUATION_FORMAT, EVALUATION_TRACES, EVALUATION_VERSION


@dataclass(frozen=True)
class EvaluateFit:
    """Replay recordings with a fitted model, open loop over the whole recording: mean absolute and RMS error of each
    joint and channel, before and after the fit."""

    recording: tuple[Path, ...]
    """Recordings to evaluate on (npz or CSV folder); all measured channels are evaluated."""
    fit: Path = Path("runs/identify")
    """Folder of a finished `identify`, `gap` or `all`. Of `all` the extended model is used, if there is one."""
    scene: Path | None = None
    """MJCF to evaluate in, if the fitted one has moved or another MJCF is wanted; a recording's own variant is applied
    anyway. Default: the fitted one."""
    user_effects: Path | None = None
    """Python file that registers your own effects, if the fit has some; it is executed."""
    out: Path = Path("runs/evaluation")
    """Results folder: evaluation.json, evaluation.npz and report.html. An earlier evaluation is replaced."""


@writes(None)
def run(command: EvaluateFit) -> None:
    """Replay, write evaluation.json and the page."""
    from droid_jax import runtime

    runtime.start()
    from droid_jax.identify.evaluation import evaluate_on, evaluation_json, evaluation_traces
    from droid_jax.preflight.check_log import check_log
    from droid_jax.report.evaluation_folder import is_evaluation, read_evaluation
    from droid_jax.report.text import lines
    from droid_jax.storage import refuse_foreign, write_json, write_npz

    recordings = [recording_at(path) for path in command.recording]
    names = [r.name for r in recordings]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"recordings need different names, got {', '.join(twice)} more than once")
    target = command.out / EVALUATION
    refuse_foreign(target, "a file", is_evaluation, "an evaluation")
    load_effects(command.user_effects, fitted_folder(command.fit)[1])
    model = load_fitted(command.fit, command.scene)
    print("compiling the replay ...", flush=True)
    replays = evaluate_on(
        model.scene,
        model.space,
        recordings,
        before=model.before,
        after=model.after,
        effects=model.effects,
        engine=model.engine,
        config=model.config,
    )
    write_npz(command.out / EVALUATION_TRACES, evaluation_traces(model.scene, replays))
    write_json(
        target,
        {
            "format": EVALUATION_FORMAT,
            "version": EVALUATION_VERSION,
            "fit": {"folder": str(command.fit), "stage": model.stage},
            "scene": model.scene.name,
            "effects": [effect.name for effect in model.effects],
            **evaluation_json(replays, model.recordings),
            "findings": [asdict(f) for recording in recordings for f in check_log(model.scene, recording)],
            "written": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "versions": runtime.versions(),
            "device": runtime.device(),
        },
    )
    report.run(report.Report(command.out))
    for line in lines("evaluation.txt.jinja", found=read_evaluation(command.out)):
        print(line)
