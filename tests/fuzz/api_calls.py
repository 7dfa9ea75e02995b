"""Every public function with one or two arguments that are wrong: of another type, shape, range or spelling.

A call is a function of named arguments with a valid value each.  A TypeError that names the argument is a refusal too.
What takes minutes (a fit, a search) is cut off once all arguments are read: `Read` is raised there, and counts as
accepted.
"""

from __future__ import annotations

import contextlib
import copy
import datetime
import decimal
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import numpy as np
from kinds import use
from model_kinds import SCENE, make_extended, make_gaussian, make_parameters, scene, space
from outcome import REFUSALS, Outcome, judged
from recording_kinds import make_npz, recording
from run_kinds import make_tables

import droid_jax
from droid_jax.cost.residuals import CompareConfig
from droid_jax.discrepancy.config import BlocksConfig, SelectionConfig
from droid_jax.identify import pipeline
from droid_jax.identify.gaussian import prior
from droid_jax.identify.multistart import RefineConfig
from droid_jax.identify.search import CmaConfig
from droid_jax.model.parameters import Mode, Parameter, Scaling, Write
from droid_jax.recordings.recording import Channel, ObjectPose, Phase, ServoGains, TorqueConvention
from droid_jax.simulate import compiled

DEEP = 100  # levels of nesting, more than numpy has axes


class Read(Exception):
    """All arguments were taken."""


@dataclass(frozen=True)
class Call:
    """name: public, in messages and results.  run: takes the arguments.  valid: a good value each."""

    name: str
    run: Callable[..., Any]
    valid: Mapping[str, Any]


def _nested() -> list[Any]:
    out: list[Any] = []
    for _ in range(DEEP):
        out = [out]
    return out


def _itself() -> list[Any]:
    out: list[Any] = []
    out.append(out)
    return out


_VALUES = (
    *(None, True, False, 0, 1, -1, 2**63, 10**400, 0.5, -0.5, 1e-320, 1e308, math.nan, math.inf, -math.inf, 1j),
    *(
        decimal.Decimal("0.3"),
        datetime.date(2020, 1, 1),
        "",
        "x",
        "0.3",
        "log",
        "door",
        "a\x00b",
        "\ud800",
        "y" * 100_000,
    ),
    *(
        "y" * 100_000,
        b"x",
        Path("no_such_file.npz"),
        "/",
        (),
        ["elbow", "elbow"],
        ["x"],
        [None],
        [1, 2],
        [[1, 2], [3]],
        range(3),
    ),
    *({}, {"torque": "x"}, {"torque": math.nan}, {1: 2}, {1, 2}, int, len, object(), np.float32(0.3), np.int8(3)),
    *(np.array(1.0), np.zeros(0), np.ones(3), np.eye(2), np.full(7, np.nan), np.array(["a", "b"]), np.ones(7, complex)),
    *(np.array([None, {}], object), np.array(["2020-01-01"], "M8[D]"), np.full((2, 20, 3), np.inf)),
)
_MADE = (list, _nested, _itself, lambda: (x for x in [1, 2]), lambda: _recording(), scene, space, lambda: _gaussian())
WRONG: tuple[Callable[[], Any], ...] = (*(functools.partial(copy.copy, value) for value in _VALUES), *_MADE)


@functools.cache
def calls(folder: Path) -> tuple[Call, ...]:
    """All of them; folder: for valid files, which this makes."""
    for make in (make_npz, make_parameters, make_gaussian, make_extended):
        make(folder)
    (folder / "tables").mkdir(exist_ok=True)
    make_tables(folder / "tables")
    return (*_of_spaces(folder), *_of_recordings(folder), *_of_gaussians(folder), *_of_studies(folder))


def _fields(of: Any) -> dict[str, Any]:
    """A value's own arguments."""
    return {f.name: getattr(of, f.name) for f in fields(of)}


def _of_spaces(folder: Path) -> tuple[Call, ...]:
    made = Parameter("mass", "kg", 1.0, 0.1, 0.1, 2.0, (), False, "Model", Scaling.LOG, 0.05, 1.0)
    of = {k: v for k, v in _fields(made).items() if k != "writes"}

    def parameter(**given: Any) -> None:
        one = droid_jax.Space((Parameter(**given),))
        use(one.from_search(one.to_search(one.mean)), one.check(one.mean), repr(one))

    def write(**given: Any) -> None:
        parameter(**of, writes=(Write(**given),))

    own, bench = space(), scene()
    loaded = {"path": SCENE, "joints": ["elbow"], "object_joint": "door", "friction_joints": ["elbow"], "assets": None}
    door = {"springs": 0, "knob": 0, "gains": "impedance", "timestep": 0.002, "limits": False}
    return (
        Call("Parameter", parameter, of),
        Call("Write", write, {"field": "body_mass", "index": (1,), "mode": Mode.SET, "gain": 1.0, "offset": 0.0}),
        Call("Space", lambda parameters: droid_jax.Space(parameters).mean, {"parameters": own.parameters}),
        Call("Space.check", own.check, {"values": own.mean}),
        Call("Space.to_search", own.to_search, {"values": own.mean}),
        Call("Space.values", own.values, {"values": {own.names[0]: 0.5}}),
        Call("Space.select", own.select, {"names": [own.names[0]]}),
        Call("load_scene", droid_jax.load_scene, loaded),
        Call("door_scene", droid_jax.door_scene, door),
        Call("load_parameters", droid_jax.load_parameters, {"path": folder / "parameters.json", "scene": bench}),
        Call("door_space", droid_jax.door_space, {"scene": _door(), "preset": "impedance"}),
        Call("door_nuisances", droid_jax.door_nuisances, {"scene": _door()}),
        Call("fitted_mjcf", droid_jax.fitted_mjcf, {"scene": bench, "space": own, "values": own.mean, "effects": ()}),
    )


def _of_recordings(folder: Path) -> tuple[Call, ...]:
    of = _recording()
    own = _fields(of)

    def saved(**given: Any) -> None:
        droid_jax.save_recording(droid_jax.Recording(**given), folder / "again.npz")

    def part(field: str, make: Callable[..., Any]) -> Callable[..., None]:
        """A recording with one of its parts made of arguments."""
        return lambda **given: saved(**{**own, field: make(**given)})

    files = {"path": folder / "wave.npz", "name": "x", "resample": False, "allow_jitter": False}
    return (
        Call("Recording", saved, own),
        Call("Channel", part("channels", lambda **g: {"torque": Channel(**g)}), _fields(of.channels["torque"])),
        Call("TorqueConvention", part("torque", TorqueConvention), _fields(of.torque)),
        Call("ObjectPose", part("object_pose", ObjectPose), _fields(of.object_pose)),
        Call("ServoGains", part("gains", ServoGains), _fields(of.gains)),
        Call("Phase", part("phases", lambda **g: (Phase(**g),)), _fields(of.phases[0])),
        Call("Recording.window", of.window, {"start": 0.0, "end": 0.1, "qpos0": {"elbow": 0.0}}),
        Call("Recording.repeats_subset", of.repeats_subset, {"indices": [0]}),
        Call("Recording.channel", of.channel, {"name": "torque"}),
        Call("load_recording", droid_jax.load_recording, files),
        Call("save_recording", droid_jax.save_recording, {"recording": of, "path": folder / "saved.npz"}),
        Call("frames", droid_jax.frames, {"folder": folder / "tables"}),
    )


def _of_gaussians(folder: Path) -> tuple[Call, ...]:
    of, bench = _gaussian(), scene()
    return (
        Call("Gaussian", lambda **given: droid_jax.Gaussian(**given).interval(), _fields(of)),
        Call("Gaussian.sample", of.sample, {"seed": 0, "n": 4}),
        Call("Gaussian.log_density", of.log_density, {"values": of.space.mean}),
        Call("Gaussian.quantiles", of.quantiles, {"q": [0.1, 0.9]}),
        Call("Gaussian.interval", of.interval, {"level": 0.9}),
        Call("Gaussian.marginal", of.marginal, {"names": [of.space.names[0]]}),
        Call("load_gaussian", droid_jax.load_gaussian, {"path": folder / "gaussian.json"}),
        Call("load_extended", droid_jax.load_extended, {"path": folder / "extended.json", "scene": bench}),
        Call("randomised", droid_jax.randomised, {"scene": bench, "gaussian": of}),
        Call("randomised_model", droid_jax.randomised_model, {"scene": bench, "gaussian": of}),
    )


def _of_studies(folder: Path) -> tuple[Call, ...]:
    """The cost, the fit and the search, cut short, and their settings."""
    of, bench, own = _recording(), scene(), space()
    several = [of, replace(of, name="other")]
    many = [_with_repeats(of, 8, name) for name in ("train", "validation")]
    given = {"scene": bench, "space": own, "recordings": several}

    def cost(**settings: Any) -> None:
        droid_jax.make_cost(**given, config=CompareConfig(**settings))

    def fit(**settings: Any) -> None:
        droid_jax.identify_parameters(**given, config=droid_jax.IdentifyConfig(**settings))

    def missing(**settings: Any) -> None:
        droid_jax.find_missing_effects(bench, own, many, config=droid_jax.DiscrepancyConfig(**settings))

    identify = {
        **given, "nuisances": None, "config": droid_jax.IdentifyConfig(), "effects": (), "progress": None,
        "checkpoints": folder / "checkpoints",
    }  # fmt: skip
    find = {
        **given, "recordings": many, "effects": None, "start": own.mean, "config": droid_jax.DiscrepancyConfig(),
        "progress": None,
    }  # fmt: skip
    calls = (
        Call("make_cost", droid_jax.make_cost, {**given, "engine": "mjx", "config": CompareConfig(), "effects": ()}),
        Call("CompareConfig", cost, _fields(CompareConfig())),
        Call("identify", droid_jax.identify_parameters, identify),
        Call("IdentifyConfig", fit, _fields(droid_jax.IdentifyConfig())),
        Call("CmaConfig", lambda **settings: fit(search=CmaConfig(**settings)), _fields(CmaConfig())),
        Call("RefineConfig", lambda **settings: fit(refine=RefineConfig(**settings)), _fields(RefineConfig())),
        Call("find_missing_effects", droid_jax.find_missing_effects, find),
        Call("DiscrepancyConfig", missing, _fields(droid_jax.DiscrepancyConfig())),
        Call(
            "SelectionConfig",
            lambda **settings: missing(selection=SelectionConfig(**settings)),
            _fields(SelectionConfig()),
        ),
        Call("BlocksConfig", lambda **settings: missing(blocks=BlocksConfig(**settings)), _fields(BlocksConfig())),
    )
    return tuple(replace(call, run=_cut_short(call.run)) for call in calls)


@functools.cache
def _recording() -> Any:
    return recording()


@functools.cache
def _gaussian() -> Any:
    return prior(space())


@functools.cache
def _door() -> Any:
    return droid_jax.door_scene()


def _with_repeats(of: Any, count: int, name: str) -> Any:
    """As many repeats as a search needs, all different."""
    rng, channels = np.random.default_rng(len(name)), {}
    for key, c in of.channels.items():
        values = np.repeat(c.values[:1], count, axis=0)
        values = np.abs(values + rng.normal(0.0, 0.01, values.shape))
        channels[key] = replace(c, values=values, mask=np.ones(values.shape, bool))
    return replace(of, name=name, channels=channels)


def _cut_short(run: Callable[..., Any]) -> Callable[..., Any]:
    """The same, but nothing is traced, compiled or replayed inside: what would be raises `Read`."""

    def read(*_: Any, **__: Any) -> Any:
        raise Read

    def call(**given: Any) -> Any:
        with contextlib.ExitStack() as stack:
            for module, name in ((compiled, "over_block"), (pipeline, "_check_start")):
                stack.enter_context(mock.patch.object(module, name, read))
            return run(**given)

    return call


def cases(all_calls: tuple[Call, ...]) -> list[tuple[int, str, int]]:
    """(call, argument, wrong value) of every argument with every wrong value, by number."""
    return [(c, a, w) for c, call in enumerate(all_calls) for a in call.valid for w in range(len(WRONG))]


def attempt(call: Call, argument: str, wrong: int, random: Random | None = None) -> Outcome:
    """The call with one argument replaced; random: draws a second one."""
    given = {**call.valid, argument: WRONG[wrong]()}
    replaced = [argument]
    if random is not None and len(call.valid) > 1:
        replaced.append(random.choice([a for a in call.valid if a != argument]))
        given[replaced[1]] = random.choice(WRONG)()

    def run() -> None:
        with contextlib.suppress(Read):
            call.run(**given)

    values = [given[name] for name in replaced]
    said = [str(value) for value in values if isinstance(value, (str, Path)) and 0 < len(str(value)) < 60]
    return judged(run, (*replaced, *said, *call.name.split(".")), refusals=(*REFUSALS, TypeError))
