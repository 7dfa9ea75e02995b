"""Check whether the measured torques fit the motion: sign, unit, order of the joints, and the arm's weight.

The measured torque is compared with a prediction at the scene's nominal values.  There are three predictions:

- the rigid body's torque along the measured motion (for joints on which only friction acts: the sign of the work),
- the servo's torque at the measured tracking error,
- without measured positions, the torque of a replay.

Each prediction is fitted within bounds that allow for model error.  An alternative, such as another sign or unit, is
reported if it leaves a much smaller share of the torque unexplained.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import linear_sum_assignment, lsq_linear

from droid_jax.model.scene import Scene
from droid_jax.preflight.findings import Finding, Kind
from droid_jax.preflight.signals import (
    FEWEST_ROWS,
    Expected,
    LogMotion,
    compensated,
    rigid_body,
    servo_torque,
    simulated_torques,
)
from droid_jax.recordings.recording import Recording, TorqueSide
from droid_jax.simulate.initial_state import weight_share

MODEL_FACTOR = 3.0  # factor by which nominal masses and servo gains may be wrong
LEAST_INERTIA = 0.1  # smallest factor on the nominal inertia; the largest is MODEL_FACTOR
OFFSET_SHARE = 0.3  # largest constant error of a sensor, as a share of the torque's root mean square
DELAYS = (0.0, 0.01, 0.02, 0.04, 0.06, 0.1)  # s, delays of the command that are tested
UNEXPLAINED = 0.3  # unexplained share of a torque's mean square above which a prediction has failed
EXPLAINED = 0.2  # unexplained share below which an alternative explains the torque;
IMPROVEMENT = 0.25  # it must also be below this factor times the share that the prediction leaves unexplained
NOTABLE_RESIDUAL = 0.03  # unexplained share above which alternatives are tested although the prediction has not failed
CLEAR_IMPROVEMENT = 0.1  # they must then reduce it below this factor
ALTERNATIVE_ROWS = 400  # rows of a motion at which alternatives are tested if the prediction has not failed
MOST_PERMUTED = 3  # up to so many joints all orders are tested, above that exchanges of two
ROTOR_FACTOR = 100.0  # largest reflected inertia of a rotor, relative to the link's inertia
PASSIVE_SHARE = 0.1  # share of a torque's root mean square below which weight and inertia are negligible
OPPOSED_WORK = 0.5  # share of the work that must oppose the motion for a finding
FRICTION_FACTOR = 100.0  # ratio to the scene's friction, weight and inertia above which the unit is doubted
CERTAIN_SHARE = 0.05  # a finding is certain if the prediction leaves nearly all and the alternative less than this
RATIO_TOLERANCE = 0.25  # relative tolerance on the factor between degrees and radians
DEGREE = np.pi / 180


def check_torque(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """Findings about the torques of a recording, or about the positions and commands that predict them."""
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


# Unexplained shares ---------------------------------------------------------------------------


def residual_share(torque: np.ndarray, terms: Iterable[tuple[np.ndarray, float, float]]) -> float:
    """Unexplained share of a torque's mean square after a bounded least-squares fit of terms and a constant.

    Args:
        torque: [K] N m (N); NaN rows are ignored.
        terms: each [K] N m (N), with the lower and the upper bound of its factor.

    Returns:
        A number from 0 to 1; 1 if fewer than FEWEST_ROWS rows are finite or the torque is zero.
    """
    terms = list(terms)
    seen = np.isfinite([torque, *(term for term, _, _ in terms)]).all(axis=0)  # a replay may end early
    power = float(np.mean(torque[seen] ** 2)) if seen.sum() >= FEWEST_ROWS else 0.0
    if power < 1e-18:
        return 1.0
    columns, low, high = [np.ones(int(seen.sum()))], [-OFFSET_SHARE], [OFFSET_SHARE]
    for term, least, most in terms:
        size = float(np.sqrt(np.mean(term[seen] ** 2)))
        if size > 1e-9:
            columns.append(term[seen] / size)
            low.append(least * size / np.sqrt(power))
            high.append(most * size / np.sqrt(power))
    # The fit needs only the components of the torque in the span of the terms; the rest is unexplained anyway.
    scaled = torque[seen] / np.sqrt(power)
    basis, small = np.linalg.qr(np.stack(columns, axis=1))
    inside = basis.T @ scaled
    found = lsq_linear(small, inside, bounds=(low, high), method="bvls")
    unexplained = 2.0 * float(found.cost) + max(0.0, float(scaled @ scaled - inside @ inside))
    return min(1.0, unexplained / len(scaled))


def body_residual_share(torque: np.ndarray, expected: Expected, *, gravity: bool, motor: bool) -> float:
    """Unexplained share of a joint's torque [K] after a fit of rigid body and friction.

    gravity: whether the torque contains the weight.  motor: whether it is the motor's, which moves the rotor too.
    """
    terms = [(expected.inertial, LEAST_INERTIA, MODEL_FACTOR), *((t, 0.0, np.inf) for t in friction_terms(expected))]
    if gravity:
        terms.append((expected.weight, 1 / MODEL_FACTOR, MODEL_FACTOR))
    if motor:
        own = float(np.sqrt(np.mean(expected.inertial**2) / (np.mean(expected.acceleration**2) + 1e-12)))
        terms.append((expected.acceleration, 0.0, ROTOR_FACTOR * own))
    return residual_share(torque, terms)


def friction_terms(expected: Expected) -> list[np.ndarray]:
    """Viscous and dry friction with unit coefficients, [K] each."""
    v = expected.velocity
    return [v, np.tanh(v / max(0.05 * float(np.abs(v).max(initial=0.0)), 1e-3))]


def factor(torque: np.ndarray, expected: np.ndarray, *others: np.ndarray) -> float:
    """Least-squares factor of an expected torque [K] in a measured one, with other terms and a constant free."""
    columns = np.stack([expected, *others, np.ones(len(torque))], axis=1)
    seen = np.isfinite(columns).all(axis=1)
    if seen.sum() < FEWEST_ROWS:
        return np.nan
    columns, torque = columns[seen], torque[seen]
    size = np.sqrt(np.mean(columns**2, axis=0)) + 1e-12
    return float(np.linalg.lstsq(columns / size, torque, rcond=None)[0][0] / size[0])


# The rigid body -------------------------------------------------------------------------------


def _of_bodies(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """Findings from inverse dynamics of the measured positions."""
    gravity, motor = recording.torque.gravity, recording.torque.side is TorqueSide.MOTOR
    torques = {joint: motion.torque[joint][motion.inner] for joint in bodies}

    def residuals(bodies: Mapping[str, Expected], torques: Mapping[str, np.ndarray], gravity: bool) -> dict[str, float]:
        return {j: body_residual_share(torques[j], bodies[j], gravity=gravity, motor=motor) for j in torques}

    stated, weightless = residuals(bodies, torques, gravity), residuals(bodies, torques, not gravity)
    if found := _of_gravity(recording, stated, weightless, "the rigid body's torques"):
        return found
    bad = [joint for joint, unexplained in stated.items() if unexplained > UNEXPLAINED]
    if not stated or (not bad and _mean(stated) < NOTABLE_RESIDUAL):
        return []
    whole: list[tuple[Kind, str, dict[str, float], str]] = []
    if not bad:
        motion = replace(motion, rows=ALTERNATIVE_ROWS)

    def tried(kind: Kind, joint: str, words: str, other: LogMotion, columns: LogMotion) -> None:
        """columns: whose torques are compared with the bodies of `other`."""
        mine = {j: columns.torque[j][columns.inner] for j in torques}
        whole.append((kind, joint, residuals(rigid_body(scene, recording, other), mine, gravity), words))

    words = "the positions are not in the stated unit: are these degrees?"
    tried("units", "", words, motion.scaled(DEGREE), motion)
    for joint in bodies:
        tried("sign", joint, f"the position of {joint} has the wrong sign", motion.turned(joint), motion)
    each = {
        j: {k: body_residual_share(torques[k], bodies[j], gravity=gravity, motor=motor) for k in torques}
        for j in bodies
    }
    order = fitting_order(each)
    if moved := [j for j, k in order.items() if j != k]:
        whole.append(("order", moved[0], {j: each[j][k] for j, k in order.items()}, _order_words(order, "torque")))
    for order in _orders(list(bodies)):
        other = motion.renamed({column: joint for joint, column in order.items()})
        tried("order", next(iter(order)), _order_words(order, "position"), other, motion)
        tried("order", next(iter(order)), _order_words(order, "all channels"), other, other)
    explained = [w for w in whole if explains(w[2], stated, bad or list(stated), 1.0 if bad else CLEAR_IMPROVEMENT)]
    others_right = len(bad) < len(bodies)
    alone = {
        joint: _alone(
            joint,
            torques[joint],
            bodies[joint],
            gravity,
            motor,
            stated[joint],
            others_right,
            1.0 if bad else CLEAR_IMPROVEMENT,
        )
        for joint in bad or [joint for joint, unexplained in stated.items() if unexplained > NOTABLE_RESIDUAL]
    }
    best = min(explained, key=lambda w: _mean(w[2]), default=None)
    where = f"recording {recording.name!r}: "
    if best is not None and not (bad and all(f is not None and f[1] <= best[2][j] + 0.02 for j, f in alone.items())):
        kind, joint, unexplained, words = best
        most = max(bad or stated, key=lambda j: stated[j])
        return [
            _finding(
                kind, joint or most, most, stated[most], unexplained[most], where + words, "the rigid body's torques"
            )
        ]
    found = [replace(f[0], sentence=where + f[0].sentence) for f in alone.values() if f is not None]
    return _register(found, list(torques))


def _of_gravity(
    recording: Recording, stated: Mapping[str, float], other: Mapping[str, float], by: str
) -> list[Finding]:
    """Findings if the torque is explained much better with the opposite statement about gravity."""
    if not stated or _mean(stated) < NOTABLE_RESIDUAL or _mean(other) > CLEAR_IMPROVEMENT * _mean(stated):
        return []
    most = max(stated, key=lambda j: stated[j] - other[j])
    words = f"recording {recording.name!r}: {_weight_words(recording.torque.gravity)}"
    return [_finding("gravity", most, most, stated[most], other[most], words, by)]


def fitting_order(unexplained: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Joint -> name of the column that its prediction explains, for the order with the smallest unexplained share.

    unexplained: joint -> column -> share of the column's torque that the joint's prediction leaves unexplained.
    """
    joints = list(unexplained)
    if not joints:
        return {}
    rows, columns = linear_sum_assignment([[unexplained[j][k] for k in joints] for j in joints])
    return {joints[i]: joints[k] for i, k in zip(rows, columns, strict=True)}


def _orders(joints: Sequence[str]) -> list[dict[str, str]]:
    """Other orders of the joints, as joint -> column: all permutations up to MOST_PERMUTED joints, else exchanges."""
    if len(joints) > MOST_PERMUTED:
        return [{one: other, other: one} for one, other in itertools.combinations(joints, 2)]
    every = [dict(zip(joints, order, strict=True)) for order in itertools.permutations(joints)]
    return [{j: k for j, k in order.items() if j != k} for order in every[1:]]


def explains(
    unexplained: Mapping[str, float], stated: Mapping[str, float], bad: Sequence[str], share: float = 1.0
) -> bool:
    """Whether an alternative explains the torques of the joints `bad`, and no other joint's torque worse than before.

    share: largest unexplained share relative to that of the prediction as stated.
    """
    spoilt = [j for j in unexplained if unexplained[j] > max(UNEXPLAINED, stated[j] + 0.05)]
    mine, before = (float(np.mean([of[j] for j in bad])) for of in (unexplained, stated))
    return not spoilt and _better(mine, before) and mine < share * before


def _better(unexplained: float, stated: float) -> bool:
    return unexplained < min(EXPLAINED, IMPROVEMENT * stated)


def _alone(
    joint: str, torque: np.ndarray, body: Expected, gravity: bool, motor: bool, stated: float, others_right: bool,
    share: float,
) -> tuple[Finding, float] | None:  # fmt: skip
    """Finding about the sign or the unit of one joint's torque, and the share that remains unexplained with it.

    share: largest unexplained share relative to that of the torque as stated.
    """

    def better(unexplained: float) -> bool:
        return _better(unexplained, stated) and unexplained < share * stated

    unexplained = partial(body_residual_share, expected=body, gravity=gravity, motor=motor)
    expected = body.weight * gravity + body.inertial
    size = factor(torque, expected, *friction_terms(body))
    by = "weight, inertia and friction"
    if better(turned := unexplained(-torque)):
        words = f"the torque of {joint} has the wrong sign, or its position has"
        return _finding("sign", joint, joint, stated, turned, words, by, value=-1.0), turned
    if size != 0 and not 1 / MODEL_FACTOR < abs(size) < MODEL_FACTOR and better(scaled := unexplained(torque / size)):
        if size < 0:
            words = f"the torque of {joint} is {size:.2g} times what the motion needs"
            return _finding("sign", joint, joint, stated, scaled, words, by, value=size), scaled
        weight = gravity and np.std(body.weight) + np.abs(np.mean(body.weight)) > np.std(body.inertial)
        of = "the arm's weight there" if weight else "what the motion needs"
        words = f"the torque of {joint} is {size:.2g} times {of}: {_unit_words(size)}"
        if size > 1 and others_right:
            words += " Or does the robot carry a load that is not in the scene?"
        return _finding("units", joint, joint, stated, scaled, words, by, value=size), scaled
    return None


# Joints on which only friction acts ----------------------------------------------------------


def _of_work(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """Findings for joints without weight and springs, whose inertia is negligible: sign of the work, and size."""
    found, passive = [], []
    for joint, body in bodies.items():
        torque, dof = motion.torque[joint][motion.inner], scene.dof(joint)
        size = _rms(torque)
        own = _rms(body.weight) * recording.torque.gravity + _rms(body.inertial)
        springs = scene.model.jnt_stiffness[scene.model.dof_jntid[dof]] or scene.model.tendon_stiffness.any()
        if size < 1e-9 or own > PASSIVE_SHARE * size or springs:
            continue
        passive.append(joint)
        where, power = f"recording {recording.name!r}: the torque of {joint}", torque * body.velocity
        work = float(power.sum() / (np.abs(power).sum() + 1e-12))
        if work < -OPPOSED_WORK:
            words = (
                f"{where} works against the motion ({-100 * work:.0f} % of the work), but friction dissipates work: "
                "the torque or the position has the wrong sign (or the scene lacks a spring that drives the joint)"
            )
            found.append(Finding("sign", joint, work, -OPPOSED_WORK, "likely", words))
            continue
        friction = scene.model.dof_frictionloss[dof] + scene.model.dof_damping[dof] * _rms(body.velocity)
        if friction > 0 and size > FRICTION_FACTOR * (friction + own):
            words = f"{where} is {size / (friction + own):.2g} times that of the scene's inertia, weight and friction"
            sentence = f"{words}: {_unit_words(size)}"
            found.append(Finding("units", joint, size, FRICTION_FACTOR * float(friction + own), "likely", sentence))
    return _register(found, passive)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# The servo ------------------------------------------------------------------------------------


def _of_servos(scene: Scene, recording: Recording, motion: LogMotion, bodies: Mapping[str, Expected]) -> list[Finding]:
    """Findings from the servo's torque, stiffness times tracking error."""
    joints = [j for j in motion.command if j in motion.position and j in motion.torque and j in scene.joints]
    servos = {j: [servo_torque(scene, motion, j, late) for late in DELAYS] for j in joints}
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
        if body_residual_share(motion.torque[joint][motion.inner], body, gravity=gravity, motor=motor) < EXPLAINED
        and gravity and np.mean(body.weight**2) > 0.25 * np.mean(motion.torque[joint] ** 2)
    ]  # fmt: skip
    return _compared(recording, torques, servos, by, right)


def _of_replay(scene: Scene, recording: Recording, motion: LogMotion) -> list[Finding]:
    """Findings from a replay of the commands, for a recording without positions."""
    if not motion.command:
        return []
    replays, by = simulated_torques(scene, recording, motion), "the torque of its replay"
    torques = {j: motion.torque[j] for j in replays}
    stated = {j: _least(torques[j], [x]) for j, x in replays.items()}
    bad = [j for j, share in stated.items() if share > UNEXPLAINED]
    if not bad:
        return []
    if found := _compared(recording, torques, {j: [x] for j, x in replays.items()}, by, ()):
        return found
    small = simulated_torques(scene, recording, motion.scaled(DEGREE))
    unexplained = {j: _least(torques[j], [x]) for j, x in small.items()}
    if explains(unexplained, stated, bad):
        joint = max(bad, key=lambda j: stated[j])
        words = f"recording {recording.name!r}: the commands are not in the stated unit: are these degrees?"
        return [_finding("units", joint, joint, stated[joint], unexplained[joint], words, by)]
    return []


def _least(torque: np.ndarray, expected: Sequence[np.ndarray]) -> float:
    """Smallest unexplained share of a torque [K] over several predictions [K]."""
    return min(residual_share(torque, [(x, 1 / MODEL_FACTOR, MODEL_FACTOR)]) for x in expected)


def _likest(torque: np.ndarray, expected: Sequence[np.ndarray]) -> np.ndarray:
    """[K] the prediction that correlates most with the measured torque [K]."""
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
    """Findings from torques and the predictions of each joint: order, sign, unit.

    right: joints whose torque is known to have the stated unit.
    """
    where = f"recording {recording.name!r}: "
    stated = {j: _least(torque, expected[j]) for j, torque in torques.items()}
    bad = [j for j, share in stated.items() if share > UNEXPLAINED]
    each = {j: {k: _least(torques[k], expected[j]) for k in torques} for j in torques}
    order = {j: k for j, k in fitting_order(each).items() if j != k}
    if order and float(np.mean([stated[j] for j in order])) > NOTABLE_RESIDUAL:
        unexplained = {j: each[j][k] for j, k in order.items()}
        if explains(unexplained, stated, list(order)):
            most = max(order, key=lambda j: stated[j])
            words = where + _order_words(order, "torque")
            return [_finding("order", most, most, stated[most], unexplained[most], words, by)]
    found, sizes = [], {}
    for joint, torque in torques.items():
        if joint in bad and _better(turned := _least(-torque, expected[joint]), stated[joint]):
            words = f"{where}the torque of {joint} is opposite to {by}: one of the two has the wrong sign"
            found.append(_finding("sign", joint, joint, stated[joint], turned, words, by, value=-1.0))
            continue
        like = _likest(torque, expected[joint])
        size, share = factor(torque, like), _least(torque, [like])
        inverse = factor(torque, turned := _likest(torque, [-x for x in expected[joint]]))
        far = inverse >= MODEL_FACTOR or 0 < inverse <= 1 / MODEL_FACTOR
        if joint in bad and far and _better(unexplained := _least(torque / inverse, [turned]), share):
            words = f"{where}the torque of {joint} is {-inverse:.2g} times {by}"
            found.append(_finding("sign", joint, joint, share, unexplained, words, by, value=-inverse))
            continue
        other = size > 0 and not 1 / MODEL_FACTOR < size < MODEL_FACTOR
        if share > UNEXPLAINED and other and _better(scaled := _least(torque / size, [like]), share):
            sizes[joint] = size, share, scaled
    degrees = bool(sizes) and all(abs(size / DEGREE - 1) < RATIO_TOLERANCE for size, _, _ in sizes.values())
    for joint, (size, share, scaled) in sizes.items():
        if degrees:
            why = "are positions and commands in degrees?"
        elif joint in right:
            why = "are the servo gains of the scene those of the robot?"
        else:
            why = f"{_unit_words(size)} Or do the servo gains of the scene differ from the robot's?"
        words = f"{where}the torque of {joint} is {size:.2g} times {by}: {why}"
        found.append(_finding("units", joint, joint, share, scaled, words, by, value=size))
    return _register(found, list(torques))


def _register(found: list[Finding], joints: Sequence[str]) -> list[Finding]:
    """The findings; if most joints have torques of the wrong sign, they also mention a load register.

    A servo's load register contains the drive's duty cycle, often with the opposite sign.
    """
    turned = [f for f in found if f.kind == "sign" and f.value < 0]
    if 2 * len(turned) <= len(joints):
        return found
    register = (
        "{}; or is this a load register, which contains the drive's duty cycle and not a torque? If so, leave that "
        "column out and fit the positions"
    )
    return [replace(f, sentence=register.format(f.sentence)) if f in turned else f for f in found]


# Words ----------------------------------------------------------------------------------------


def _finding(
    kind: Kind, column: str, joint: str, stated: float, unexplained: float, words: str, by: str, value: float = 0.0
) -> Finding:
    """A finding; stated, unexplained: unexplained share of the torque as recorded, and with the alternative."""
    sure = stated > 1 - CERTAIN_SHARE and unexplained < CERTAIN_SHARE
    grounds = f"{by} leaves {100 * stated:.0f} % of the torque of {joint} unexplained as recorded"
    sentence = f"{words.rstrip('.')} ({grounds}, {100 * unexplained:.0f} % with this change)"
    return Finding(
        kind, column, value or stated, 1.0 if value else unexplained, "certain" if sure else "likely", sentence
    )


def _unit_words(size: float) -> str:
    """Question about the unit of a torque that is `size` times as large as expected."""
    if size < 1:
        what = "are these amperes, or fractions of the largest torque?"
    else:
        what = "are these milliamperes, N mm or per cent?"
    return f"{what} `convert --torque-constant` takes the value of one unit in N m."


def _weight_words(gravity: bool) -> str:
    return (
        "the recording states that the torque contains the arm's weight, but it holds no weight: convert it without "
        "--gravity (TorqueConvention.gravity)"
        if gravity
        else "the recording states that the torque holds no weight, but it contains the arm's: convert it with "
        "--gravity (TorqueConvention.gravity)"
    )


def _order_words(order: Mapping[str, str], what: str) -> str:
    """Sentence about an order; order: joint -> the joint under whose name its column was recorded."""
    moved = {j: k for j, k in order.items() if j != k}
    if len(moved) == 2:
        return f"{' and '.join(moved)} seem to be exchanged in {what}: check the columns' names"
    named = ", ".join(f"{k} is {j}" for j, k in moved.items())
    return f"joints seem to be in another order in {what} (what is called {named}): check the columns' names"


def _mean(residuals: Mapping[str, float]) -> float:
    return float(np.mean(list(residuals.values())))
