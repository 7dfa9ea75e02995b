"""Train a policy with brax's PPO.

Paper, section IV-D: actor and critic have two hidden layers of 64 with tanh; Adam has a step size of 1e-3; an episode
has at most 512 actions.
"""

from __future__ import annotations

import droid_jax.model.quiet_mjx  # noqa: F401  brax would import mujoco.mjx with its two lines about warp

# isort: split
import contextlib
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo import train as ppo

from droid_jax.arguments import check_fields, number, optional, several, whole
from droid_jax.identify.checkpoints import Checkpoints
from droid_jax.policy.control import LAYOUT, Policy
from droid_jax.policy.environment import Environment
from droid_jax.policy.evaluate import batch_of_episodes
from droid_jax.policy.network import layer_sizes, policy_of
from droid_jax.policy.parallel import AXIS, wrapped
from droid_jax.policy.randomise import Randomise
from droid_jax.policy.trials import BLOWN_UP


@dataclass(frozen=True)
class TrainConfig:
    """Settings of PPO; the defaults are the preset "quick".

    Attributes:
        steps: total number of actions over all environments, rounded up to whole rounds.
        envs: environments in parallel, over all devices.
        devices: number of devices for training; None: the most that divide `envs` and `batch`.  Evaluations use all.
        hidden: sizes of the hidden layers of actor and critic.
        learning_rate: of Adam.
        discount: discount factor.
        gae: lambda of generalised advantage estimation.
        clip: clipping range of the probability ratio.
        entropy: weight of the entropy bonus.
        reward_scaling: factor on rewards.
        unroll: actions between updates.
        batch: unrolls of a minibatch.
        minibatches: number of minibatches.
        epochs: number of updates with each minibatch.
        evaluations: number of evaluations (each saves a checkpoint) during the training.
        eval_envs: episodes of an evaluation.
        enough: success rate that ends the training,
        held: number of last evaluations whose mean, and the last of which alone, must reach it; 0: the training makes
            all its steps.
        seed: of all randomness.

    Raises:
        ValueError: a value is invalid, or batch * minibatches is no multiple of envs.
    """

    steps: int = 4_000_000
    envs: int = 256
    devices: int | None = None
    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 1e-3
    discount: float = 0.98
    gae: float = 0.95
    clip: float = 0.2
    entropy: float = 5e-3
    reward_scaling: float = 0.1
    unroll: int = 16
    batch: int = 32
    minibatches: int = 8
    epochs: int = 6
    evaluations: int = 31
    eval_envs: int = 128
    enough: float = 0.98
    held: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        counts = ("steps", "envs", "unroll", "batch", "minibatches", "epochs", "evaluations", "eval_envs")
        check_fields(
            self,
            **dict.fromkeys(counts, partial(whole, least=1)),
            **dict.fromkeys(("learning_rate", "clip", "reward_scaling"), partial(number, above=0)),
            **dict.fromkeys(("discount", "gae"), partial(number, least=0, most=1)),
            devices=optional(partial(whole, least=1)),
            hidden=several(partial(whole, least=1)),
            entropy=partial(number, least=0),
            enough=partial(number, above=0, most=1),
            held=partial(whole, least=0),
            seed=partial(whole, least=0),
        )
        if (self.batch * self.minibatches) % self.envs:
            raise ValueError(
                f"batch x minibatches ({self.batch} x {self.minibatches}) must be a multiple of the {self.envs} "
                "environments"
            )


PRESETS = {
    "quick": TrainConfig(),
    "paper": TrainConfig(steps=20_000_000, batch=64, evaluations=40, eval_envs=128),
    "gpu": TrainConfig(steps=40_000_000, envs=4096, batch=512, minibatches=8, evaluations=40, eval_envs=512),
}


@dataclass(frozen=True)
class TrainProgress:
    """The state of a training after an evaluation.

    Attributes:
        step: actions so far.
        of: total number of actions.
        seconds: since the training began, with compilation and without pauses.
        rate: actions per second since the last evaluation, including this one.
        reward: mean of the episodes.
        success: share of episodes.
        blown_up: share of episodes whose simulation diverged.  They count as failures here (unlike in `Trials`), so
            that a policy with few valid episodes is not selected as the best.
    """

    step: int
    of: int
    seconds: float
    rate: float
    reward: float
    success: float
    blown_up: float = 0.0

    @property
    def remaining(self) -> float:
        """s that the remaining actions take at this rate; infinite before the first update."""
        return max(0, self.of - self.step) / self.rate if self.rate > 0 else float("inf")


@dataclass(frozen=True, eq=False)
class TrainedPolicy:
    """The result of a training.

    Attributes:
        policy: with the highest success rate in an evaluation, and among those with the highest reward.  PPO's last
            update is not always its best.
        history: all evaluations.
        held: whether the training ended early (`TrainConfig.held`).
    """

    policy: Policy
    history: tuple[TrainProgress, ...]
    held: bool = False


def train(
    env: Environment,
    randomise: Randomise | None = None,
    config: TrainConfig | None = None,
    *,
    checkpoints: Path | None = None,
    fingerprint: dict[str, str] | None = None,
    progress: Callable[[TrainProgress], None] = lambda now: None,
) -> TrainedPolicy:
    """Train a policy.

    Args:
        env: the environment.
        randomise: draws the physics of the environments; None: all have those of `env`.
        config: settings of PPO.
        checkpoints: folder for the networks after each evaluation; an interrupted training continues from it, with the
            same draws of the physics, but with new moments of Adam and new starts.
        fingerprint: further properties that must agree with those of a checkpoint.
        progress: is called after each evaluation.

    Returns:
        The best policy and the history.

    Raises:
        ValueError: a checkpoint belongs to another run or network, there are too few devices, or the weights of all
            policies are NaN or infinite.
    """
    config = config or TrainConfig()
    config = replace(config, devices=_devices(config))
    scene = f"{env.scene.name}, {env.scene.sha256}, {env.start.tolist()}"
    of = {"scene": scene, "effects": ", ".join(e.name for e in env.effects), "task": repr(asdict(env.task))}
    settings = {name: value for name, value in asdict(config).items() if name not in ("steps", "devices")}
    texts = {"config": repr(settings), "observation": repr(LAYOUT), **of}
    texts |= fingerprint or {}
    run = functools.partial(_brax, env, randomise, config)
    if checkpoints is None:
        return run(None, 0, progress, lambda step, params: None)
    with Checkpoints(checkpoints, fingerprint=texts) as saved:
        restored = saved.restore()
        step, tree = restored if restored is not None else (0, None)
        return run(tree, step, progress, saved.save)


def _devices(config: TrainConfig) -> int:
    """Number of devices to use; ValueError if there are fewer, or if it does not divide environments and batch.

    The batch must be divisible since brax splits the unrolls of each device into the same number of minibatches.
    """
    available = jax.local_device_count()
    if config.devices is None:
        return max(d for d in range(1, available + 1) if config.envs % d == config.batch % d == 0)
    if not 1 <= config.devices <= available:
        raise ValueError(f"{config.devices} devices were requested, there are {available}")
    for count, what in ((config.envs, "environments"), (config.batch, "unrolls of a minibatch")):
        if count % config.devices:
            raise ValueError(f"{count} {what} do not divide among {config.devices} devices")
    return config.devices


def _brax(
    env: Environment,
    randomise: Randomise | None,
    config: TrainConfig,
    tree: dict[str, Any] | None,
    done: int,
    progress: Callable[[TrainProgress], None],
    save: Callable[[int, dict[str, Any]], None],
) -> TrainedPolicy:
    """Run brax's PPO after `done` actions, from the networks of a checkpoint's `tree` if there is one."""
    history = [TrainProgress(int(row[0]), *row[1:]) for row in tree["history"].tolist()] if tree else []
    began = time.monotonic() - (history[-1].seconds if history else 0.0)
    best: Any = None
    batch: Any = None  # of episodes, compiled once
    key = jax.random.key(config.seed)

    def as_policy(params: Any) -> Policy:
        normaliser, actor, _ = params
        return policy_of(normaliser, actor, layer_sizes(config.hidden), env.interface)

    def updated(step: int, _: Any, params: Any) -> None:
        """Evaluate brax's parameters after `step` actions; 0 is before the first, or at the checkpoint."""
        nonlocal best, batch
        if step and not _finite(params):
            raise _Ended
        batch = batch or batch_of_episodes(env, randomise, config.eval_envs, jax.random.fold_in(key, 1))
        played = batch(as_policy(params), jax.random.fold_in(key, 2 + done + step))
        seconds = time.monotonic() - began
        now = TrainProgress(
            step=done + step,
            of=config.steps,
            seconds=seconds,
            rate=(done + step - history[-1].step) / (seconds - history[-1].seconds) if step else 0.0,
            reward=played.reward,
            success=float(played.trials.success.mean()),
            blown_up=float((played.trials.stopped == BLOWN_UP).mean()),
        )
        progress(now)
        if not step:
            if not history:
                history.append(now)
            return
        if best is None or _rank(now) >= max(_rank(h) for h in history if h.step):
            best = params
        history.append(now)
        rows = np.array([list(asdict(h).values()) for h in history], np.float64)
        save(done + step, {"latest": to_tree(params), "best": to_tree(best), "history": rows})
        if _held(history, config):
            raise _Ended

    with replicated():
        params: Any = None
        if tree is not None:
            blank = _blank(env, config)
            params, best = (from_tree(blank, tree[name]) for name in ("latest", "best"))
        if done < config.steps and not _held(history, config):
            with contextlib.suppress(_Ended):
                _ppo(env, randomise, config, done, params, updated)
    if best is None:
        raise ValueError(
            "training ended in NaN or infinite weights: try another --seed "
            "(in Python, a smaller TrainConfig.learning_rate too)"
        )
    return TrainedPolicy(as_policy(best), tuple(history), _held(history, config) and history[-1].step < config.steps)


def _ppo(
    env: Environment,
    randomise: Randomise | None,
    config: TrainConfig,
    done: int,
    restore: Any,
    updated: Callable[[int, Any, Any], None],
) -> Any:
    """Call brax's PPO with the settings of `config`, for the actions after `done`; `updated` gets its parameters."""
    steps = config.steps - done
    return ppo.train(
        environment=env,
        num_timesteps=steps,
        num_envs=config.envs,
        episode_length=env.task.steps,
        learning_rate=config.learning_rate,
        entropy_cost=config.entropy,
        discounting=config.discount,
        unroll_length=config.unroll,
        batch_size=config.batch,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        normalize_observations=True,
        reward_scaling=config.reward_scaling,
        clipping_epsilon=config.clip,
        gae_lambda=config.gae,
        network_factory=_networks(config),
        seed=config.seed + done,
        num_evals=evaluations_left(config, steps),
        num_eval_envs=1,
        run_evals=False,  # brax's use one device
        randomization_fn=randomise,
        wrap_env_fn=wrapped(randomise, config.devices or 1, config.seed),
        max_devices_per_host=config.devices,
        restore_params=restore,
        policy_params_fn=updated,
    )


class _Ended(Exception):
    """Ends a training whose success is sufficient, or whose weights are NaN or infinite."""


def _held(history: Sequence[TrainProgress], config: TrainConfig) -> bool:
    """Whether success was sufficient in the last evaluation, and in the last `config.held` ones together."""
    last = [now.success for now in history[-config.held :]] if config.held else []
    return len(last) == config.held > 0 and min(last[-1], sum(last) / len(last)) >= config.enough


def _networks(config: TrainConfig) -> Callable[..., Any]:
    """brax's factory of actor and critic for given sizes of observation and action."""
    return functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=config.hidden,
        value_hidden_layer_sizes=config.hidden,
        activation=jnp.tanh,
    )


def _blank(env: Environment, config: TrainConfig) -> Any:
    """Initial parameters in brax's form, (normaliser, actor, critic)."""
    nets, key = _networks(config)(env.observation_size, env.action_size), jax.random.key(0)
    size: Any = env.observation_size
    normaliser = running_statistics.init_state(specs.Array((size,), jnp.dtype("float32")))
    return normaliser, nets.policy_network.init(key), nets.value_network.init(key)


def evaluations_left(config: TrainConfig, steps: int) -> int:
    """brax's number of evaluations for the last `steps` actions, so that a continued run keeps the intervals.

    The number includes brax's evaluation before the first action.  All intervals have the same number of whole rounds,
    so the number is chosen to exceed the requested actions as little as possible.
    """
    rounds = math.ceil(steps / (config.batch * config.minibatches * config.unroll))
    parts = max(1, round((config.evaluations - 1) * steps / config.steps))
    return 1 + math.ceil(rounds / math.ceil(rounds / parts))


def _rank(now: TrainProgress) -> tuple[float, float]:
    return now.success, now.reward


def _finite(params: Any) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


def to_tree(params: Any) -> dict[str, Any]:
    """brax's (normaliser, actor, critic) as a nested dictionary of numpy arrays."""
    return jax.tree.map(np.asarray, flax.serialization.to_state_dict(dict(zip(_NAMES, params, strict=True))))


def from_tree(blank: Any, tree: dict[str, Any]) -> Any:
    """The inverse of `to_tree`, given parameters of the same networks; ValueError for other networks."""
    target = dict(zip(_NAMES, blank, strict=True))
    try:
        restored = flax.serialization.from_state_dict(target, tree)
    except (KeyError, ValueError) as error:
        raise ValueError(f"the checkpoint holds another network: {error}") from None
    for expected, given in zip(jax.tree.leaves(target), jax.tree.leaves(restored), strict=True):
        if np.shape(expected) != np.shape(given):
            raise ValueError(
                f"the checkpoint holds a layer of shape {np.shape(given)}, this network one of {np.shape(expected)}"
            )
    return tuple(restored[name] for name in _NAMES)


_NAMES = ("normaliser", "actor", "critic")
_REPLICATED = "device_put_replicated"


class replicated:
    """Provide jax.device_put_replicated, which brax 0.14.2 calls once and jax 0.10 removed, as `put_replicated`."""

    def __init__(self, module: Any = jax) -> None:
        self._module = module

    def __enter__(self) -> None:
        self._own = vars(self._module).get(_REPLICATED)  # jax 0.9 has it in a function that warns of it
        setattr(self._module, _REPLICATED, put_replicated)

    def __exit__(self, *_: object) -> None:
        if self._own is None:
            delattr(self._module, _REPLICATED)
        else:
            setattr(self._module, _REPLICATED, self._own)


def put_replicated(tree: Any, devices: Any) -> Any:
    """A copy of every array on every device, [devices, ...], with the type and the place of a result of brax's pmap.

    Then its program is compiled once, for the first call and for later ones.
    """

    def one(_: Any, copied: Any) -> Any:
        # Results have no weak types.
        return jax.tree.map(lambda a: jax.lax.convert_element_type(a, jnp.result_type(a)), copied)

    return jax.pmap(one, axis_name=AXIS, in_axes=(0, None), devices=devices)(np.arange(len(devices)), tree)
