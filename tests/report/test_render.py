"""Pictures of a scene, and films: as many pictures as asked for, in the time they took, sides beside each other."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from droid_jax.report import render
from droid_jax.report import render as module
from droid_jax.report.render import LONGEST, LOOPS, SIZE, film

XML = """<mujoco><visual><global offwidth="64" offheight="48"/></visual><worldbody>
<light pos="0 0 3"/><camera name="front" pos="0 -2 0" xyaxes="1 0 0 0 0 1"/>
<body><joint name="slide" type="slide" axis="1 0 0"/><geom type="sphere" size="0.2" rgba="1 0 0 1"/></body>
</worldbody></mujoco>"""


def _backend() -> str:
    try:
        return render.working_backend()
    except render.NoOpenGL as error:
        pytest.skip(str(error))


@pytest.mark.gl
def test_frames_show_where_the_body_is() -> None:
    import mujoco

    _backend()
    model = mujoco.MjModel.from_xml_string(XML)
    qpos = np.array([[-0.5], [0.0], [0.5]])
    images = render.rendered_frames(model, qpos, [0, 1, -1], size=(48, 64))
    centres = []
    for image in images:
        assert image.shape == (48, 64, 3) and image.dtype == np.uint8
        red = image[..., 0].astype(int) - image[..., 1] > 60
        centres.append(np.flatnonzero(red.any(axis=0)).mean())
    assert centres[0] < centres[1] - 10 and centres[2] > centres[1] + 10
    assert centres[1] == pytest.approx(31.5, abs=1.5)


@pytest.mark.gl
def test_a_model_without_geoms_shows_its_inertias() -> None:
    _backend()
    body = "<body><joint type='slide'/><inertial pos='0 0 0' mass='1' diaginertia='.02 .02 .02'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    (image,) = render.rendered_frames(model, np.zeros((1, 1)), [0], None, size=(48, 64))
    assert np.ptp(image) > 60


def test_a_point_mass_is_seen_where_it_swings() -> None:
    _backend()
    body = "<body><joint axis='0 1 0'/><inertial pos='0 0 -.1' mass='1' diaginertia='1e-6 1e-6 1e-6'/></body>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    hanging, raised = render.rendered_frames(model, np.array([[0.0], [1.5]]), [0, 1], None, size=(48, 64))
    bright = [np.argwhere(image.max(axis=2) > 120).mean(axis=0) for image in (hanging, raised)]
    assert bright[1][0] < bright[0][0] - 3  # higher up in the picture


def test_frames_refuse_what_does_not_fit_the_model() -> None:
    import mujoco

    model = mujoco.MjModel.from_xml_string(XML)
    with pytest.raises(ValueError, match=r"\[T, 1\].*\(3, 2\)"):
        render.rendered_frames(model, np.zeros((3, 2)), [0], size=(48, 64))
    with pytest.raises(ValueError, match="index 3 is outside"):
        render.rendered_frames(model, np.zeros((3, 1)), [3], size=(48, 64))
    with pytest.raises(ValueError, match="row 1 is not finite"):
        render.rendered_frames(model, np.array([[0.0], [np.nan]]), [0, 1], size=(48, 64))
    with pytest.raises(ValueError, match="no camera 'back'; this model has: front"):
        render.rendered_frames(model, np.zeros((1, 1)), [0], camera="back", size=(48, 64))
    with pytest.raises(ValueError, match=r"\(48, 64\), got \(480, 640\)"):
        render.rendered_frames(model, np.zeros((1, 1)), [0])


def test_without_opengl_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setenv("MUJOCO_GL", "none_such")  # what it finds is kept, and no other test asks about this one
    monkeypatch.setattr(
        render, "_child", lambda backend, *_: asked.append(backend) or "the process died with signal 11"
    )
    for _ in range(2):
        with pytest.raises(render.NoOpenGL, match=r"egl \(the process died with signal 11\).*libosmesa6"):
            render.working_backend()
    assert asked == ["none_such", "egl", "osmesa"]
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(render.NoOpenGL, match="turns drawing off"):
        render.working_backend()


def test_a_backend_that_cannot_draw_is_a_message_not_a_crash() -> None:
    assert "invalid value" in render._child("nonsense", None, 60.0)
    assert render._candidates("glfw", "linux") == ["glfw", "egl", "osmesa"]
    assert render._candidates("", "linux") == ["egl", "osmesa"]


MODEL = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><joint name='hinge'/><geom size='.1'/></body></worldbody></mujoco>"
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Pictures without OpenGL: the shade of each is its state."""
    states: list[np.ndarray] = []

    def frames(model, qpos, indices, camera, size) -> list[np.ndarray]:
        states.append(np.asarray(qpos)[list(indices)])
        return [np.full((*size, 3), int(200 * state[0]), np.uint8) for state in states[-1]]

    monkeypatch.setattr(module, "rendered_frames", frames)
    return states


def states(length: int, top: float = 1.0) -> np.ndarray:
    return np.linspace(0.0, top, length)[:, None]


def test_two_sides_move_together(drawn, tmp_path: Path):
    film(tmp_path / "film.webp", MODEL, (states(40), states(40, 0.5)), 0.04, None)
    with Image.open(tmp_path / "film.webp") as found:
        assert found.size == (2 * SIZE[1], SIZE[0]) and found.n_frames == 20  # type: ignore[attr-defined]
        assert found.info["loop"] == LOOPS > 0  # motion without end could not be stopped
        found.seek(19)
        last = np.asarray(found.convert("L"), float)
    left, right = last[:, : SIZE[1]].mean(), last[:, SIZE[1] :].mean()
    assert left == pytest.approx(2 * right, rel=0.05) and left > 150


def test_a_long_film_leaves_pictures_out(drawn, tmp_path: Path):
    film(tmp_path / "film.webp", MODEL, [states(1000)], 0.04)
    assert len(drawn[0]) <= LONGEST


def test_sides_of_different_length_are_refused(tmp_path: Path):
    with pytest.raises(ValueError, match=r"as long as each other, got \[4, 5\] states"):
        film(tmp_path / "film.webp", MODEL, (states(4), states(5)), 0.04)
