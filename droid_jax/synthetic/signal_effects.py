"""Hidden effects on signals: what happens to a command before the servo, and to a torque in its sensor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from droid_jax.synthetic.hooks import Hidden, Influence, Place, Seen, lagged

GAIN_KNEE = 20.0  # N m, where the torque sensor's wrong gain begins to level off
DRIFT_TIME = 60.0  # s, a sensor warming up
CREEP_TIME = 0.5  # s, a torque sensor's body
SETTLING_TIME = 2.0  # s, a sensor that has just been loaded


def hide_command_delay(place: Place, a: float) -> Influence:
    """The command arrives a s late: 0.7 a of dead time, then a first-order lag of 0.3 a."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        control[:, place.actuators] = lagged(control[:, place.actuators], clock, 0.7 * a, 0.3 * a)
        return control

    return Influence(command=command)


def hide_clock_rate(place: Place, a: float) -> Influence:
    """Commands at 1 + a (1 + 0.2 sin(t / 3 s)) of the recorder's rate: two quartzes, one that warms and cools."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        run = clock - clock[0]
        at = clock + a * (run + 0.6 * (1.0 - np.cos(run / 3.0)))
        control = control.copy()
        for column in place.actuators:
            control[:, column] = np.interp(at, clock, control[:, column])
        return control

    return Influence(command=command)


def hide_velocity_feedforward(place: Place, a: float) -> Influence:
    """The command and a s of its speed, which the servo takes behind a first-order lag of 8 ms."""

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        control = control.copy()
        own = control[:, place.actuators]
        speed = np.gradient(own, clock, axis=0)
        control[:, place.actuators] = own + a * lagged(speed, clock, 0.0, 0.008)
        return control

    return Influence(command=command)


def hide_inner_profile(place: Place, a: float) -> Influence:
    """The servo's own goal, which speeds up by at most 1 / a and is driven into place within 4 ms; a in s^2/rad.

    It brakes with nine tenths of that, so as not to overshoot.
    """

    def command(clock: np.ndarray, control: np.ndarray) -> np.ndarray:
        if a == 0.0:
            return control
        control, h = control.copy(), float(clock[1] - clock[0])
        own = control[:, place.actuators]
        at, speed = own[0].copy(), np.zeros(own.shape[1])
        for k, goal in enumerate(own.copy()):
            way = goal - at
            wanted = np.sign(way) * np.minimum(np.abs(way) / 0.004, np.sqrt(1.8 / a * np.abs(way)))
            speed = speed + np.clip(wanted - speed, -h / a, h / a)
            at = at + h * speed
            own[k] = at
        control[:, place.actuators] = own
        return control

    return Influence(command=command)


def hide_crosstalk(place: Place, a: float) -> Influence:
    """A sensor also reads a tau (1 + 0.1 sin(2 q)) of the joint before its own, of the first joint the one behind it.

    It leaks through the bearing, which goes by the joint's own angle q.
    """

    def sense(seen: Seen) -> Seen:
        torque = seen.torque.copy()
        if torque.shape[1] > 1:
            beside = np.where(place.columns > 0, place.columns - 1, 1)
            turned = 1.0 + 0.1 * np.sin(2.0 * seen.position[:, place.columns])
            torque[:, place.columns] += a * turned * seen.torque[:, beside]
        return Seen(seen.clock, torque, seen.position)

    return Influence(sense=sense)


def hide_sensor_delay(place: Place, a: float) -> Influence:
    """The torque arrives a s late: 0.6 a of dead time, then a first-order lag of 0.4 a; positions do not.

    The joints are asked one after the other: a is the mean, the first one's is 0.8 of it and the last one's 1.2.
    """

    def late(seen: Seen, torque: np.ndarray, _: np.ndarray) -> np.ndarray:
        delays = a * np.linspace(0.8, 1.2, torque.shape[1]) if torque.shape[1] > 1 else [a]
        each = [lagged(torque[:, [k]], seen.clock, 0.6 * d, 0.4 * d) for k, d in enumerate(delays)]
        return np.concatenate(each, axis=1)

    return _on_torque(place, late)


def hide_torque_bias(place: Place, a: float) -> Influence:
    """torque + a (1 + 0.2 sin q + 0.3 exp(-t / 2 s)): a zero that moves a little as the joint turns, and settles.

    a in N m, t from the start of each repeat.
    """

    def biased(seen: Seen, torque: np.ndarray, position: np.ndarray) -> np.ndarray:
        return torque + a * (1.0 + 0.2 * np.sin(position) + 0.3 * np.exp(-seen.clock[:, None] / SETTLING_TIME))

    return _on_torque(place, biased)


def hide_torque_gain(place: Place, a: float) -> Influence:
    """torque + a (0.7 x + 0.3 y), x = t tanh(torque / t), t = 20 N m: a wrong gain that levels off.

    y is x behind a first-order lag of 0.5 s, what the sensor's body creeps; a without unit.
    """

    def gained(seen: Seen, torque: np.ndarray, _: np.ndarray) -> np.ndarray:
        level = GAIN_KNEE * np.tanh(torque / GAIN_KNEE)
        return torque + a * (0.7 * level + 0.3 * lagged(level, seen.clock, 0.0, CREEP_TIME))

    return _on_torque(place, gained)


def hide_torque_drift(place: Place, a: float) -> Influence:
    """torque + a (1 - exp(-t / 60 s)): a sensor that warms up, t from the start of the first repeat; a in N m."""
    before = place.repeat * place.period
    return _on_torque(
        place, lambda seen, torque, _: torque - a * np.expm1(-(before + seen.clock[:, None]) / DRIFT_TIME)
    )


def _on_torque(place: Place, formula: Callable[[Seen, np.ndarray, np.ndarray], np.ndarray]) -> Influence:
    """An effect out of a formula (seen, torque [T, C], position [T, C]) -> torque [T, C]."""

    def sense(seen: Seen) -> Seen:
        torque = seen.torque.copy()
        torque[:, place.columns] = formula(seen, torque[:, place.columns], seen.position[:, place.columns])
        return Seen(seen.clock, torque, seen.position)

    return Influence(sense=sense)


SIGNALS = (
    Hidden("command_delay", "s", (0.002, 0.02), "arm", hide_command_delay, "commands that arrive late"),
    Hidden(
        "clock_rate", "-", (0.002, 0.01), "arm", hide_clock_rate, "commands on a clock of another rate", signed=True
    ),
    Hidden(
        "feedforward", "s", (0.005, 0.05), "arm", hide_velocity_feedforward, "a servo that looks ahead", signed=True
    ),
    Hidden("inner_profile", "s^2/rad", (0.01, 0.2), "arm", hide_inner_profile, "a servo whose goal speeds up slowly"),
    Hidden("sensor_delay", "s", (0.002, 0.02), "arm", hide_sensor_delay, "torques that arrive late"),
    Hidden("torque_bias", "N m", (0.1, 1.0), "arm", hide_torque_bias, "a torque sensor off zero", signed=True),
    Hidden("torque_gain", "-", (0.03, 0.2), "arm", hide_torque_gain, "a torque sensor of wrong gain", signed=True),
    Hidden("crosstalk", "-", (0.02, 0.15), "arm", hide_crosstalk, "a sensor that reads its neighbour", signed=True),
    Hidden("torque_drift", "N m", (0.2, 1.5), "arm", hide_torque_drift, "a torque sensor that warms up", signed=True),
)
