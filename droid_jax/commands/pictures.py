"""Pictures of a fit: the measured motion, the replay before and after it, as states, film, frames and viewer."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from droid_jax import distributed
from droid_jax.files import FILMS, FITTED, REPLAY, REPLAY_FILM, VIEWER

if TYPE_CHECKING:
    import numpy as np

    from droid_jax.identify.pipeline import Identified
    from droid_jax.model.scene import Scene
    from droid_jax.recordings.recording import Recording

RATE = 25.0  # states per second
FRAME_TIMES = (0.0, 0.33, 0.6, 1.0)  # of the motion, at which frames are drawn
FRAMES = "frames"


def keep_replay(out: Path, found: Identified, recording: Recording) -> None:
    """Write replay.npz: a recording's commands replayed in plain C before and after the fit, and the measured motion.

    The replay and the pictures of an earlier fit are removed first.  A recording without commands has no replay.
    """
    import numpy as np

    from droid_jax.model.physics import make_c_model
    from droid_jax.model.variant import variant_scene
    from droid_jax.simulate.c_engine import poses
    from droid_jax.simulate.replay import make_drive
    from droid_jax.simulate.servo_gains import scale_gains, servo_factors
    from droid_jax.storage import write_npz

    _forget(out)
    if not recording.command.size:
        return
    scene = variant_scene(found.scene, recording.variant, recording.name)
    drive = make_drive(scene, recording, weigh=False)
    every, factors = max(1, round(1.0 / (RATE * drive.timestep))), servo_factors(scene, drive)
    models = (
        scale_gains(make_c_model(scene, found.full, found.full.with_known(drive.known, v)), factors)
        for v in (found.start, found.best)
    )
    before, after = (poses(model, drive.qpos0, drive.command)[::every] for model in models)
    time = drive.timestep * every * np.arange(len(after))
    states = {"time": time, "before": before, "after": after, "recording": np.array(recording.name)}
    write_npz(out / REPLAY, {**states, **measured_states(found.scene, recording, time, after)})


def measured_states(scene: Scene, recording: Recording, time: np.ndarray, else_: np.ndarray) -> dict[str, np.ndarray]:
    """The measured motion for replay.npz; empty if no joint's position was measured.

    Args:
        scene: that was replayed.
        recording: mean of its repeats.
        time: [K] s after the first command.
        else_: [K, nq] positions of joints that were not measured.

    Returns:
        `measured` [K, nq], the names of the `measured_joints`, and `start`, the first command's time, s.
    """
    import numpy as np

    from droid_jax.recordings.recording import POSITION_CHANNELS

    states, joints, start = else_.copy(), list[str](), float(recording.time[0])
    for channel in (recording.channels[name] for name in POSITION_CHANNELS if name in recording.channels):
        for c, joint in enumerate(channel.columns):
            values, mask = channel.values[:, :, c], channel.mask[:, :, c]
            there = mask.any(axis=0)
            if there.sum() < 2 or joint not in scene.single_joints:
                continue
            mean = np.where(mask, values, 0.0).sum(axis=0)[there] / mask.sum(axis=0)[there]
            states[:, scene.qpos(joint)] = np.interp(start + time, channel.time[there], mean)
            joints.append(joint)
    return {"measured": states, "measured_joints": np.array(joints), "start": np.array(start)} if joints else {}


def draw_replay(out: Path) -> None:
    """Draw the film, the frames and the viewer of replay.npz with the fitted scene, unless they exist.

    If this fails (no OpenGL, a diverged replay) a message is printed, and the page has no pictures.
    """
    if not distributed.first() or not (out / REPLAY).is_file() or (out / FRAMES).is_dir():
        return
    import mujoco

    from droid_jax.model.scene import for_pictures
    from droid_jax.report.reading import Reader, read_replay
    from droid_jax.report.render import NoOpenGL, film, rendered_frames, save_frames
    from droid_jax.report.viewer import write_viewer
    from droid_jax.storage import new_folder

    if not (out / FITTED).is_file():
        print(f"no pictures: there is no {FITTED}, see the notes of the page", file=sys.stderr)
        return
    of = (out / REPLAY).stat().st_mtime_ns
    try:
        time, before, after = read_replay(out / REPLAY, Reader("identify"))
        model = for_pictures(mujoco.MjModel.from_xml_path(str(out / FITTED)))
        camera = "front" if "front" in {model.camera(i).name for i in range(model.ncam)} else None
        rows = [int(f * (len(after) - 1)) for f in FRAME_TIMES]
        images = rendered_frames(model, after, rows, camera)
        period = float(time[1]) if len(time) > 1 else 1.0 / RATE
        drawn = film(out / FILMS / REPLAY_FILM, model, (before, after), period, camera)
        write_viewer(out, model, camera, drawn)
    except (NoOpenGL, ValueError) as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return
    if not (out / REPLAY).is_file() or (out / REPLAY).stat().st_mtime_ns != of:
        return  # of another fit by now
    with new_folder(out / FRAMES) as folder:  # last: it marks that everything is drawn
        save_frames(folder, images, [float(time[r]) for r in rows], "after")


def _forget(out: Path) -> None:
    """Remove the pictures of an earlier fit."""
    for path in (out / REPLAY, out / FILMS / REPLAY_FILM, out / VIEWER):
        path.unlink(missing_ok=True)
    shutil.rmtree(out / FRAMES, ignore_errors=True)
