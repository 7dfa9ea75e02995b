"""Hidden effects on signals: on commands before they reach the servo, and on torques in their sensor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Place, SensorInput, lagged

GAIN_KNEE = 20.0  # N m, at which the torque sensor's gain error saturates
DRIFT_TIME = 60.0  # s, time constant of a torque sensor that warms up
CREEP_TIME = 0.5  # s, time constant of creep in a torque sensor's body
SETTLING_TIME = 2.0  # s, time constant with which a torque sensor's zero settles


def hide_command_delay(place: Place, a: float) -> Influence:
    """A command delay of a s: dead time 0.7 a, then a first-order lag of 0.3 a."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] = lagged(control[:, place.actuators], clock, 0.7 * a, 0.3 * a)
        return control

    return Influence(command=command)


def hide_clock_rate(place: Place, a: float) -> Influence:
    """Commands at 1 + a (1 + 0.2 sin(t / 3 s)) times the recorder's rate: two clocks, one with varying temperature."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        elapsed = clock - clock[0]
        at = clock + a * (elapsed + 0.6 * (1.0 - np.cos(elapsed / 3.0)))
        control = control.copy()
        for column in place.actuators:
            control[:, column] = np.interp(at, clock, control[:, column])
        return control

    return Influence(command=command)


def hide_velocity_feedforward(place: Place, a: float) -> Influence:
    """The command plus a s times its speed, which passes a first-order lag of 8 ms."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        commands = control[:, place.actuators]
        speed = np.gradient(commands, clock, axis=0)
        control[:, place.actuators] = commands + a * lagged(speed, clock, 0.0, 0.008)
        return control

    return Influence(command=command)


def hide_inner_profile(place: Place, a: float) -> Influence:
    """A servo that follows the command by a profile with limited acceleration 1 / a; a in s^2/rad.

    It brakes with nine tenths of the acceleration, so that it does not overshoot, and reaches the goal with a time
    constant of 4 ms.
    """

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        if a == 0.0:
            return control
        control, h = control.copy(), float(clock[1] - clock[0])
        profile = control[:, place.actuators]
        at, speed = profile[0].copy(), np.zeros(profile.shape[1])
        for k, goal in enumerate(profile.copy()):
            distance = goal - at
            wanted = np.sign(distance) * np.minimum(np.abs(distance) / 0.004, np.sqrt(1.8 / a * np.abs(distance)))
            speed = speed + np.clip(wanted - speed, -h / a, h / a)
            at = at + h * speed
            profile[k] = at
        control[:, place.actuators] = profile
        return control

    return Influence(command=command)


def hide_crosstalk(place: Place, a: float) -> Influence:
    """A sensor also reads a tau (1 + 0.1 sin(2 q)), tau of the joint before its own (the second for the first joint).

    The leakage passes the bearing and depends on the sensor's own joint angle q.
    """

    def sense(signals: SensorInput) -> SensorInput:
        torque = signals.torque.copy()
        if torque.shape[1] > 1:
            neighbours = np.where(place.columns > 0, place.columns - 1, 1)
            leakage = a * (1.0 + 0.1 * np.sin(2.0 * signals.position[:, place.columns]))
            torque[:, place.columns] += leakage * signals.torque[:, neighbours]
        return SensorInput(signals.clock, torque, signals.position)

    return Influence(sense=sense)


def hide_sensor_delay(place: Place, a: float) -> Influence:
    """A delay of the torques of a s: dead time 0.6 a, then a first-order lag of 0.4 a.  Positions have none.

    The sensors are polled one after the other: the delay rises from 0.8 a of the first joint to 1.2 a of the last.
    """

    def delayed(signals: SensorInput, torque: np.ndarray, _: np.ndarray) -> np.ndarray:
        delays = a * np.linspace(0.8, 1.2, torque.shape[1]) if torque.shape[1] > 1 else [a]
        each = [lagged(torque[:, [k]], signals.clock, 0.6 * d, 0.4 * d) for k, d in enumerate(delays)]
        return np.concatenate(each, axis=1)

    return _on_torque(place, delayed)


def hide_torque_bias(place: Place, a: float) -> Influence:
    """torque + a (1 + 0.2 sin q + 0.3 exp(-t / 2 s)): a zero offset that depends on the joint angle and settles.

    a in N m, t from the start of each repeat.
    """

    def biased(signals: SensorInput, torque: np.ndarray, position: np.ndarray) -> np.ndarray:
        return torque + a * (1.0 + 0.2 * np.sin(position) + 0.3 * np.exp(-signals.clock[:, None] / SETTLING_TIME))

    return _on_torque(place, biased)


def hide_torque_gain(place: Place, a: float) -> Influence:
    """torque + a (0.7 x + 0.3 y), x = t tanh(torque / t), t = 20 N m: a gain error that saturates.

    y is x after a first-order lag of 0.5 s, the creep of the sensor's body; a without unit.
    """

    def gained(signals: SensorInput, torque: np.ndarray, _: np.ndarray) -> np.ndarray:
        level = GAIN_KNEE * np.tanh(torque / GAIN_KNEE)
        return torque + a * (0.7 * level + 0.3 * lagged(level, signals.clock, 0.0, CREEP_TIME))

    return _on_torque(place, gained)


def hide_torque_drift(place: Place, a: float) -> Influence:
    """torque + a (1 - exp(-t / 60 s)): a sensor that warms up, t from the start of the first repeat; a in N m."""
    before = place.repeat * place.period
    return _on_torque(
        place, lambda signals, torque, _: torque - a * np.expm1(-(before + signals.clock[:, None]) / DRIFT_TIME)
    )


def _on_torque(place: Place, formula: Callable[[SensorInput, np.ndarray, np.ndarray], np.ndarray]) -> Influence:
    """An effect from a formula (signals, torque [T, C], position [T, C]) -> torque [T, C]."""

    def sense(signals: SensorInput) -> SensorInput:
        torque = signals.torque.copy()
        torque[:, place.columns] = formula(signals, torque[:, place.columns], signals.position[:, place.columns])
        return SensorInput(signals.clock, torque, signals.position)

    return Influence(sense=sense)


SIGNALS = (
    Hidden("command_delay", "s", (0.002, 0.02), "arm", hide_command_delay, "commands that arrive late"),
    Hidden(
        "clock_rate", "-", (0.002, 0.01), "arm", hide_clock_rate, "commands on a clock of another rate", signed=True
    ),
    Hidden(
        "feedforward",
        "s",
        (0.005, 0.05),
        "arm",
        hide_velocity_feedforward,
        "a servo with feedforward",
        signed=True,
    ),
    Hidden("inner_profile", "s^2/rad", (0.01, 0.2), "arm", hide_inner_profile, "a servo with a profile of its own"),
    Hidden("sensor_delay", "s", (0.002, 0.02), "arm", hide_sensor_delay, "torques that arrive late"),
    Hidden("torque_bias", "N m", (0.1, 1.0), "arm", hide_torque_bias, "a zero offset of torque sensors", signed=True),
    Hidden("torque_gain", "-", (0.03, 0.2), "arm", hide_torque_gain, "a gain error of torque sensors", signed=True),
    Hidden("crosstalk", "-", (0.02, 0.15), "arm", hide_crosstalk, "a sensor that reads its neighbour", signed=True),
    Hidden("torque_drift", "N m", (0.2, 1.5), "arm", hide_torque_drift, "a torque sensor that warms up", signed=True),
)
