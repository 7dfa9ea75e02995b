"""The folder of a trained policy as typed values: training.json, transfer.json and films, checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypedDict

from msgspec import Struct, field

from droid_jax.files import FILMS, TRAINING, TRANSFER
from droid_jax.policy.trials import BLOWN_UP
from droid_jax.report.reading import Reader


class TrainingSetup(Struct, frozen=True):
    """Options of a training."""

    method: Literal["fitted", "mean", "prior"]
    preset: str
    knob: int
    seed: int
    fit: str | None  # None: no fit, the prior


class TrainingRobot(TypedDict, total=False):
    """Description of the synthetic robot that was fitted; empty for your own recordings."""

    springs: int
    seed: int
    hide: list[str] | None  # None: what is hidden by default


class TrainedTask(Struct, frozen=True):
    """opened: rad; held, control: s; steps: actions of an episode."""

    opened: float
    held: float
    control: float
    steps: int


class Progress(Struct, frozen=True):
    """An evaluation during training; seconds since its start, rate in actions/s, of: actions asked for."""

    step: int
    seconds: float
    rate: float
    reward: float
    success: float
    of: float = 0.0


class Training(Struct, frozen=True, kw_only=True):
    """training.json. held: training ended early since it had succeeded often enough."""

    setup: TrainingSetup
    synthetic_robot: TrainingRobot
    task: TrainedTask
    scene: str
    effects: list[str]
    versions: dict[str, Any]
    device: str
    history: list[Progress]
    held: bool = False

    @property
    def another_robot(self) -> bool:
        """Whether your own recordings were fitted: the synthetic robot is then another robot."""
        return self.setup.fit is not None and not self.synthetic_robot


class Spread(Struct, frozen=True):
    """Mean and deviation over trials, None where no trial counts; and the value of each trial."""

    mean: float | None
    std: float | None
    all: list[float]


class GripEntry(Struct, frozen=True):
    """Mean share of actions with the knob gripped."""

    mean: float


class Rate(Struct, frozen=True):
    """Share of the trials in one place that succeeded, and its interval."""

    success_rate: float
    interval_95: tuple[float, float]


class TrialsEntry(Rate, frozen=True):
    """Results of the trials in one place (`policy.trials.Trials.to_json`)."""

    trials: int
    success: list[bool]
    stopped: dict[str, int]
    angle_deg: Spread
    steps: Spread
    grip: GripEntry
    stopped_each: list[str] | None = None

    @property
    def counted(self) -> int:
        """Trials, those that blew up left out."""
        return self.trials - self.stopped.get(BLOWN_UP, 0)

    @property
    def angles(self) -> list[float]:
        """Largest angle of each of them, degrees."""
        each = self.stopped_each or [""] * self.trials
        return [a for a, why in zip(self.angle_deg.all, each, strict=True) if why != BLOWN_UP]

    def faults(self) -> Iterator[str]:
        """Faults that the types cannot express."""
        each = self.stopped_each
        for key, of in (("angle_deg", self.angle_deg.all), ("success", self.success), ("stopped_each", each)):
            if of is not None and len(of) != self.trials:
                yield f"{key!r} has {len(of)} trials, 'trials' says {self.trials}"


class HiddenEffect(Struct, frozen=True):
    """An effect hidden in the synthetic robot."""

    name: str
    amplitude: float
    joint: str | None = None
    unit: str = "-"


class TransferRobot(Struct, frozen=True):
    """The synthetic robot of the trials."""

    hidden: list[HiddenEffect]


class Rates(Struct, frozen=True):
    """The success rates of transfer.json."""

    simulation: Rate
    synthetic_robot: Rate


class Transfer(Struct, frozen=True):
    """transfer.json."""

    simulation: TrialsEntry
    synthetic_robot: TrialsEntry
    robot: TransferRobot
    no_films: str | None = None
    setup: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Trained:
    """The folder of `train`.

    transfer: None before `evaluate`.  films: by name, "good" and "bad".
    """

    folder: Path
    training: Training
    transfer: Transfer | None
    films: Mapping[str, Path]

    @property
    def trials(self) -> dict[str, TrialsEntry]:
        """Place of the trials -> their results."""
        if self.transfer is None:
            return {}
        return {"simulation": self.transfer.simulation, "synthetic robot": self.transfer.synthetic_robot}


def has_policy(folder: Path) -> bool:
    """Whether a folder holds, or should hold, a trained policy."""
    return (folder / TRAINING).exists()


def read_training(folder: Path) -> Training:
    """training.json, checked; ValueError where it is missing or broken."""
    return Reader("train").json(folder / TRAINING, Training)


def read_rates(folder: Path) -> dict[str, Rate]:
    """Success by place, of transfer.json; ValueError where it is broken."""
    rates = Reader("evaluate").json(folder / TRANSFER, Rates)
    return {"in simulation": rates.simulation, "on the synthetic robot": rates.synthetic_robot}


def read_policy(folder: Path) -> Trained:
    """Load and check; ValueError names the file that is missing or broken."""
    training, transfer = read_training(folder), None
    if (folder / TRANSFER).is_file():
        read = Reader("evaluate")
        transfer = read.json(folder / TRANSFER, Transfer)
        for where, trials in (("simulation", transfer.simulation), ("synthetic_robot", transfer.synthetic_robot)):
            for fault in trials.faults():
                raise read.fault(f"{folder / TRANSFER}, {where!r}, {fault}")
    films = {path.stem: path for path in sorted((folder / FILMS).glob("*.webp"))}
    return Trained(folder, training, transfer, films)
