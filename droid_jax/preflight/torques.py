"""Whether the measured torques are those of the motion: sign, unit, order of the joints, and the arm's weight.

Three expectations, each at the scene's nominal values: the rigid body's torque along the measured motion (of joints
that friction alone holds back: the sign of its work), the servo's at the measured tracking error and, where no
position was measured, the replay's.  Each is fitted within bounds that a
wrong model may reach; what it leaves of the torque is compared with what it leaves under an alternative.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import linear_sum_assignment, lsq_linear

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding, Kind
from droid_jax.preflight.signals import (
    FEWEST,
    Expected,
    LogMotion,
    compensated,
    rigid_body,
    servo_torque,
    simulated_torques,
)
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.simulate.initial_state import weight_share

BOUND = 3.0  # factor by which nominal masses and servo gains may be wrong
LEAST_INERTIA = 0.1  # of the nominal inertia that must be seen, and three times of it at most
OFFSET = 0.3  # of a torque's root mean square, that a sensor's constant error may have
LATE = (0.0, 0.01, 0.02, 0.04, 0.06, 0.1)  # s by which a command may take effect late
BAD = 0.3  # share of a torque's mean square that stays unexplained, from which on an expectation has failed
GOOD = 0.2  # share below which an alternative explains it,
BETTER = 0.25  # and of what the expectation left
VISIBLE, CLEARLY = 0.03, 0.1  # share from which on the weight in a torque is looked for, and what it must leave of it
ROUGH = 400  # rows of a motion at which alternatives are tried where the expectation has not failed
MOST = 3  # joints of which all orders of the positions are tried
ROTOR = 100.0  # times a link's own inertia, that a rotor behind its gear may have
SMALL = 0.1  # share of a torque's root mean square, up to which weight and inertia have no part in it
TAKEN = 0.5  # share of the work done, that must go against the motion
HUGE = 100.0  # times what the scene says that the motion takes
SURE = 0.05  # share below which it does so beyond doubt
SAME = 0.25  # relative deviation within which a factor is that of degrees
DEGREE = np.pi / 180

Left = Callable[[np.ndarray], float]  # torque [K] -> share that an expectation leaves


def check_torque(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """What is wrong with the torques, or with what they are judged by."""
    if not motion.torque:
        return []
    if not motion.position:
        return _of_replay(scene, recording, motion)
    bodies = rigid_body(scene, recording, motion)
    return (
        _of_bodies(scene, recording, motion, bodies)
        or _of_work(scene, recording, motion, bodies)
        or _of_servos(scene, recording, motion, bodies)
    )


# What is left ---------------------------------------------------------------------------------


def left_by(torque: np.ndarray, terms: Iterable[tuple[np.ndarray, float, float]]) -> float:
    """Share of a torque's mean square that terms, each [K] with the bounds of its factor, and a constant leave."""
    terms = list(terms)
    seen = np.isfinite([torque, *(term for term, _, _ in terms)]).all(axis=0)  # a replay may have ended before
    power = float(np.mean(torque[seen] ** 2)) if seen.sum() >= FEWEST else 0.0
    if power < 1e-18:
        return 1.0
    columns, low, high = [np.ones(int(seen.sum()))], [-OFFSET], [OFFSET]
    for term, least, most in terms:
        size = float(np.sqrt(np.mean(term[seen] ** 2)))
        if size > 1e-9:
            columns.append(term[seen] / size)
            low.append(least * size / np.sqrt(power))
            high.append(most * size / np.sqrt(power))
    # As many rows as terms hold all that the fit needs of them; the rest of the torque is left in any case.
    scaled = torque[seen] / np.sqrt(power)
    basis, small = np.linalg.qr(np.stack(columns, axis=1))
    inside = basis.T @ scaled
    found = lsq_linear(small, inside, bounds=(low, high), method="bvls")
    left = 2.0 * float(found.cost) + max(0.0, float(scaled @ scaled - inside @ inside))
    return min(1.0, left / len(scaled))


def left_by_body(torque: np.ndarray, expected: Expected, *, gravity: bool, motor: bool) -> float:
    """Share of a joint's torque [K] that rigid body, friction and, at the motor, a rotor's inertia leave.

    gravity: the torque contains the weight.
    """
    terms = [(expected.inertial, LEAST_INERTIA, BOUND), *((t, 0.0, np.inf) for t in friction_terms(expected))]
    if gravity:
        terms.append((expected.weight, 1 / BOUND, BOUND))
    if motor:
        own = float(np.sqrt(np.mean(expected.inertial**2) / (np.mean(expected.acceleration**2) + 1e-12)))
        terms.append((expected.acceleration, 0.0, ROTOR * own))
    return left_by(torque, terms)


def friction_terms(expected: Expected) -> list[np.ndarray]:
    """[K] each: viscous and dry, of a size that is to be found."""
    v = expected.velocity
    return [v, np.tanh(v / max(0.05 * float(np.abs(v).max(initial=0.0)), 1e-3))]


def factor(torque: np.ndarray, expected: np.ndarray, *others: np.ndarray) -> float:
    """By how much a torque [K] is larger than an expected one, beside others of free size and a constant."""
    columns = np.stack([expected, *others, np.ones(len(torque))], axis=1)
    seen = np.isfinite(columns).all(axis=1)
    if seen.sum() < FEWEST:
        return np.nan
    columns, torque = columns[seen], torque[seen]
    size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    return float(np.linalg.lstsq(columns / size, torque, rcond=None)[0][0] / size[0])


# The rigid body -------------------------------------------------------------------------------


def _of_bodies(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """By inverse dynamics of the measured positions."""
    gravity, motor = recording.torque.gravity, recording.torque.side is TorqueSide.MOTOR
    torques = {joint: motion.torque[joint][motion.inner] for joint in bodies}

    def lefts(bodies: Mapping[str, Expected], torques: Mapping[str, np.ndarray], gravity: bool) -> dict[str, float]:
        return {j: left_by_body(torques[j], bodies[j], gravity=gravity, motor=motor) for j in torques}

    stated, weightless = lefts(bodies, torques, gravity), lefts(bodies, torques, not gravity)
    if found := _of_gravity(recording, stated, weightless, "the rigid body's torques"):
        return found
    bad = [joint for joint, left in stated.items() if left > BAD]
    if not stated or (not bad and _mean(stated) < VISIBLE):
        return []
    whole: list[tuple[Kind, str, dict[str, float], str]] = []
    if not bad:
        motion = replace(motion, rows=ROUGH)

    def tried(kind: Kind, joint: str, words: str, other: LogMotion, columns: LogMotion) -> None:
        """columns: whose torques are compared with the bodies of `other`."""
        mine = {j: columns.torque[j][columns.inner] for j in torques}
        whole.append((kind, joint, lefts(rigid_body(scene, recording, other), mine, gravity), words))

    words = "the positions are not in the unit that is stated: are these degrees?"
    tried("units", "", words, motion.scaled(DEGREE), motion)
    for joint in bodies:
        tried("sign", joint, f"the position of {joint} has the wrong sign", motion.turned(joint), motion)
    each = {j: {k: left_by_body(torques[k], bodies[j], gravity=gravity, motor=motor) for k in torques} for j in bodies}
    order = fitting_order(each)
    if moved := [j for j, k in order.items() if j != k]:
        whole.append(("order", moved[0], {j: each[j][k] for j, k in order.items()}, _order_words(order, "torque")))
    for order in _orders(list(bodies)):
        other = motion.renamed({column: joint for joint, column in order.items()})
        tried("order", next(iter(order)), _order_words(order, "position"), other, motion)
        tried("order", next(iter(order)), _order_words(order, "all channels"), other, other)
    explained = [w for w in whole if explains(w[2], stated, bad or list(stated), 1.0 if bad else CLEARLY)]
    others_right = len(bad) < len(bodies)
    alone = {
        joint: _alone(
            joint, torques[joint], bodies[joint], gravity, motor, stated[joint], others_right, 1.0 if bad else CLEARLY
        )
        for joint in bad or [joint for joint, left in stated.items() if left > VISIBLE]
    }
    best = min(explained, key=lambda w: _mean(w[2]), default=None)
    where = f"recording {recording.name!r}: "
    if best is not None and not (bad and all(f is not None and f[1] <= best[2][j] + 0.02 for j, f in alone.items())):
        kind, joint, left, words = best
        most = max(bad or stated, key=lambda j: stated[j])
        return [
            _finding(kind, joint or most, most, stated[most], left[most], where + words, "the rigid body's torques")
        ]
    found = [replace(f[0], sentence=where + f[0].sentence) for f in alone.values() if f is not None]
    return _register(found, list(torques))


def _of_gravity(
    recording: Recording, stated: Mapping[str, float], other: Mapping[str, float], by: str
) -> list[Finding]:
    """What is left with the weight in the torque, as stated, against what is left without, or the other way round."""
    if not stated or _mean(stated) < VISIBLE or _mean(other) > CLEARLY * _mean(stated):
        return []
    most = max(stated, key=lambda j: stated[j] - other[j])
    words = f"recording {recording.name!r}: {_weight_words(recording.torque.gravity)}"
    return [_finding("gravity", most, most, stated[most], other[most], words, by)]


def fitting_order(left: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Joint -> the joint as whose its column was recorded, of all orders the one that leaves least.

    left: joint -> column -> share of the column's torque that the joint's expectation leaves.
    """
    joints = list(left)
    if not joints:
        return {}
    rows, columns = linear_sum_assignment([[left[j][k] for k in joints] for j in joints])
    return {joints[i]: joints[k] for i, k in zip(rows, columns, strict=True)}


def _orders(joints: Sequence[str]) -> list[dict[str, str]]:
    """Other orders of the joints, the changes alone: all of up to three joints, else two exchanged."""
    if len(joints) > MOST:
        return [{one: other, other: one} for one, other in itertools.combinations(joints, 2)]
    every = [dict(zip(joints, order, strict=True)) for order in itertools.permutations(joints)]
    return [{j: k for j, k in order.items() if j != k} for order in every[1:]]


def explains(left: Mapping[str, float], stated: Mapping[str, float], bad: Sequence[str], share: float = 1.0) -> bool:
    """Whether an alternative explains the torques of the joints where the expectation failed, and spoils no other.

    share: of what the expectation leaves, that the alternative may at most.
    """
    spoilt = [j for j in left if left[j] > max(BAD, stated[j] + 0.05)]
    mine, before = (float(np.mean([of[j] for j in bad])) for of in (left, stated))
    return not spoilt and _better(mine, before) and mine < share * before


def _better(left: float, stated: float) -> bool:
    return left < min(GOOD, BETTER * stated)


def _alone(
    joint: str, torque: np.ndarray, body: Expected, gravity: bool, motor: bool, stated: float, others_right: bool,
    share: float,
) -> tuple[Finding, float] | None:  # fmt: skip
    """What is wrong with one joint's torque: its sign or its unit; with what it leaves.

    share: of what the torque as stated leaves, that it may at most.
    """

    def better(left: float) -> bool:
        return _better(left, stated) and left < share * stated

    left = partial(left_by_body, expected=body, gravity=gravity, motor=motor)
    expected = body.weight * gravity + body.inertial
    size = factor(torque, expected, *friction_terms(body))
    by = "weight, inertia and friction"
    if better(turned := left(-torque)):
        words = f"the torque of {joint} has the wrong sign, or its position has"
        return _finding("sign", joint, joint, stated, turned, words, by, value=-1.0), turned
    if size != 0 and not 1 / BOUND < abs(size) < BOUND and better(scaled := left(torque / size)):
        if size < 0:
            words = f"the torque of {joint} is {size:.2g} of what the motion takes"
            return _finding("sign", joint, joint, stated, scaled, words, by, value=size), scaled
        weight = gravity and np.std(body.weight) + np.abs(np.mean(body.weight)) > np.std(body.inertial)
        of = "the arm's weight there" if weight else "what the motion takes"
        words = f"the torque of {joint} is {size:.2g} of {of}: {_unit_words(size)}"
        if size > 1 and others_right:
            words += " Or does the robot carry a load that the scene lacks?"
        return _finding("units", joint, joint, stated, scaled, words, by, value=size), scaled
    return None


# Joints that friction alone holds back -------------------------------------------------------


def _of_work(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """By the work that friction takes, where neither weight nor spring acts and inertia is small; and by its size."""
    found, passive = [], []
    for joint, body in bodies.items():
        torque, dof = motion.torque[joint][motion.inner], scene.dof(joint)
        size = _rms(torque)
        own = _rms(body.weight) * recording.torque.gravity + _rms(body.inertial)
        springs = scene.model.jnt_stiffness[scene.model.dof_jntid[dof]] or scene.model.tendon_stiffness.any()
        if size < 1e-9 or own > SMALL * size or springs:
            continue
        passive.append(joint)
        where, power = f"recording {recording.name!r}: the torque of {joint}", torque * body.velocity
        work = float(power.sum() / (np.abs(power).sum() + 1e-12))
        if work < -TAKEN:
            words = (
                f"{where} works against the motion ({-100 * work:.0f} % of it), and friction takes work: it has the "
                "wrong sign, or its position has (or a spring that the scene lacks drives the joint)"
            )
            found.append(Finding("sign", joint, work, -TAKEN, "likely", words))
            continue
        friction = scene.model.dof_frictionloss[dof] + scene.model.dof_damping[dof] * _rms(body.velocity)
        if friction > 0 and size > HUGE * (friction + own):
            words = (
                f"{where} is {size / (friction + own):.2g} times what inertia, weight and friction of the scene take"
            )
            sentence = f"{words}: {_unit_words(size)}"
            found.append(Finding("units", joint, size, HUGE * float(friction + own), "likely", sentence))
    return _register(found, passive)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# The servo ------------------------------------------------------------------------------------


def _of_servos(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """By stiffness times tracking error."""
    joints = [j for j in motion.command if j in motion.position and j in motion.torque and j in scene.joints]
    servos = {j: [servo_torque(scene, motion, j, late) for late in LATE] for j in joints}
    gravity, by = recording.torque.gravity, "kp x tracking error"
    carried = compensated(scene, recording, motion)
    torques, flipped = (
        {j: motion.torque[j] - weight_share(scene.model, np.array([scene.dof(j)]), holds) * carried[j] for j in joints}
        for holds in (gravity, not gravity)
    )
    stated, other = ({j: _least(t, servos[j]) for j, t in of.items()} for of in (torques, flipped))
    if found := _of_gravity(recording, stated, other, by):
        return found
    motor = recording.torque.side is TorqueSide.MOTOR
    right = [
        joint
        for joint, body in bodies.items()
        if left_by_body(motion.torque[joint][motion.inner], body, gravity=gravity, motor=motor) < GOOD
        and gravity and np.mean(body.weight**2) > 0.25 * np.mean(motion.torque[joint] ** 2)
    ]  # fmt: skip
    return _compared(recording, torques, servos, by, right)


def _of_replay(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """By a replay of the commands, of a recording without positions."""
    if not motion.command:
        return []
    replays, by = simulated_torques(scene, recording, motion), "the torque of its replay"
    torques = {j: motion.torque[j] for j in replays}
    stated = {j: _least(torques[j], [x]) for j, x in replays.items()}
    bad = [j for j, share in stated.items() if share > BAD]
    if not bad:
        return []
    if found := _compared(recording, torques, {j: [x] for j, x in replays.items()}, by, ()):
        return found
    small = simulated_torques(scene, recording, motion.scaled(DEGREE))
    left = {j: _least(torques[j], [x]) for j, x in small.items()}
    if explains(left, stated, bad):
        joint = max(bad, key=lambda j: stated[j])
        words = f"recording {recording.name!r}: the commands are not in the unit that is stated: are these degrees?"
        return [_finding("units", joint, joint, stated[joint], left[joint], words, by)]
    return []


def _least(torque: np.ndarray, expected: Sequence[np.ndarray]) -> float:
    """The least share of a torque [K] that one of several expected ones leaves."""
    return min(left_by(torque, [(x, 1 / BOUND, BOUND)]) for x in expected)


def _likest(torque: np.ndarray, expected: Sequence[np.ndarray]) -> np.ndarray:
    """[K] of several expected torques the one that is most like the measured one, whatever its size."""
    if len(expected) == 1:
        return expected[0]
    known = [x for x in expected if np.isfinite(x).all() and np.std(x) > 0]
    return (
        max(known, key=lambda x: float(np.corrcoef(torque, x)[0, 1])) if known and np.std(torque) > 0 else expected[0]
    )


def _compared(
    recording: Recording, torques: Mapping[str, np.ndarray], expected: Mapping[str, Sequence[np.ndarray]], by: str,
    right: Sequence[str],
) -> list[Finding]:  # fmt: skip
    """Torques compared with the expected traces of each joint.

    right: joints whose torque is known to be in its unit.
    """
    where = f"recording {recording.name!r}: "
    stated = {j: _least(torque, expected[j]) for j, torque in torques.items()}
    bad = [j for j, share in stated.items() if share > BAD]
    each = {j: {k: _least(torques[k], expected[j]) for k in torques} for j in torques}
    order = {j: k for j, k in fitting_order(each).items() if j != k}
    if order and float(np.mean([stated[j] for j in order])) > VISIBLE:
        left = {j: each[j][k] for j, k in order.items()}
        if explains(left, stated, list(order)):
            most = max(order, key=lambda j: stated[j])
            words = where + _order_words(order, "torque")
            return [_finding("order", most, most, stated[most], left[most], words, by)]
    found, sizes = [], {}
    for joint, torque in torques.items():
        if joint in bad and _better(turned := _least(-torque, expected[joint]), stated[joint]):
            words = f"{where}the torque of {joint} runs against {by}: one of the two has the wrong sign"
            found.append(_finding("sign", joint, joint, stated[joint], turned, words, by, value=-1.0))
            continue
        like = _likest(torque, expected[joint])
        size, share = factor(torque, like), _least(torque, [like])
        inverse = factor(torque, turned := _likest(torque, [-x for x in expected[joint]]))
        far = inverse >= BOUND or 0 < inverse <= 1 / BOUND
        if joint in bad and far and _better(left := _least(torque / inverse, [turned]), share):
            words = f"{where}the torque of {joint} is {-inverse:.2g} of {by}"
            found.append(_finding("sign", joint, joint, share, left, words, by, value=-inverse))
            continue
        other = size > 0 and not 1 / BOUND < size < BOUND
        if share > BAD and other and _better(scaled := _least(torque / size, [like]), share):
            sizes[joint] = size, share, scaled
    degrees = bool(sizes) and all(abs(size / DEGREE - 1) < SAME for size, _, _ in sizes.values())
    for joint, (size, share, scaled) in sizes.items():
        if degrees:
            why = "are positions and commands in degrees?"
        elif joint in right:
            why = "are the servo's gains those of the robot?"
        else:
            why = f"{_unit_words(size)} Or are the servo's gains others than the robot's?"
        words = f"{where}the torque of {joint} is {size:.2g} of {by}: {why}"
        found.append(_finding("units", joint, joint, share, scaled, words, by, value=size))
    return _register(found, list(torques))


def _register(found: list[Finding], joints: Sequence[str]) -> list[Finding]:
    """The findings, with what torques of the other sign may be where most joints have them.

    A servo's load register states the drive's duty as a share, often of the other sign.
    """
    turned = [f for f in found if f.kind == "sign" and f.value < 0]
    if 2 * len(turned) <= len(joints):
        return found
    register = (
        "{}; or is this a load register, the share that the drive puts out, and no torque? Leave that column out then, "
        "and fit the positions"
    )
    return [replace(f, sentence=register.format(f.sentence)) if f in turned else f for f in found]


# Words ----------------------------------------------------------------------------------------


def _finding(
    kind: Kind, column: str, joint: str, stated: float, left: float, words: str, by: str, value: float = 0.0
) -> Finding:
    """stated, left: what `by` leaves of a joint's torque as recorded, and under the alternative."""
    sure = stated > 1 - SURE and left < SURE
    grounds = f"left unexplained of the torque of {joint} by {by}: {100 * stated:.0f} % as recorded"
    sentence = f"{words.rstrip('.')} ({grounds}, {100 * left:.0f} % otherwise)"
    return Finding(kind, column, value or stated, 1.0 if value else left, "certain" if sure else "likely", sentence)


def _unit_words(size: float) -> str:
    """What a torque may be that is `size` times as large as it should be."""
    if size < 1:
        what = "are these amperes, or shares of the largest torque?"
    else:
        what = "are these milliamperes, N mm or per cent?"
    return f"{what} `convert --torque-constant` takes what one unit is in N m."


def _weight_words(gravity: bool) -> str:
    return (
        "the torque is said to contain the arm's weight and holds none: leave --gravity away (TorqueConvention.gravity)"
        if gravity
        else "the torque is said to hold no weight, and holds the arm's: state it (--gravity, TorqueConvention.gravity)"
    )


def _order_words(order: Mapping[str, str], what: str) -> str:
    """order: joint -> the joint under whose name its column stands."""
    moved = {j: k for j, k in order.items() if j != k}
    if len(moved) == 2:
        return f"{' and '.join(moved)} seem to be exchanged in {what}: check the columns' names"
    named = ", ".join(f"{k} is {j}" for j, k in moved.items())
    return f"joints seem to be in another order in {what} (what is called {named}): check the columns' names"


def _mean(lefts: Mapping[str, float]) -> float:
    return float(np.mean(list(lefts.values())))
