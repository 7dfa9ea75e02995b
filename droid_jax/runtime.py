"""Settings to make before jax starts, and a description of the machine for results.

Importing this module neither imports jax nor sets anything.  A program calls `tune()` first;
a library user may instead pass `compiler_options()` to their `jax.jit`.

Why the fusion emitters are switched off: XLA's CPU backend fuses the kinematic chain of a
seven-joint arm into one expression that recomputes its producers again and again, thousands of
times slower than without (jax-ml/jax#33761, google-deepmind/mujoco#2957).
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import importlib
import importlib.metadata
import math
import os
import platform
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from droid_jax import distributed
from droid_jax.installation import check_mujoco
from droid_jax.quiet import before_jax, quiet_cache
from droid_jax.quiet import quiet as quiet
from droid_jax.storage import write_json

if TYPE_CHECKING:
    from jax.sharding import Mesh

Function = TypeVar("Function", bound=Callable[..., Any])
EMITTERS = "xla_cpu_use_fusion_emitters"
# Thresholds of Python's garbage collector.  A trace makes millions of small objects; with Python's own (700, 10, 10)
# the search for cycles among them takes a tenth of its time.
GARBAGE_THRESHOLDS = (50_000, 10, 10)
# Precision of float32 matrix products.  By default a GPU rounds their factors to 10 bits (TF32): on an H200 the door's
# torques then differ by up to 8e-3 N m from a CPU's, in full precision by 3e-4, at the same speed.
PRODUCTS = "highest"
CACHE_VARIABLE = "DROID_JAX_CACHE"
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "evosax", "brax", "numpy", "scipy")
LOOP_BOUND = b"xla_cpu_small_while_loop_byte_threshold"  # XLA compiles loops that touch fewer bytes into one kernel
EVERY_LOOP = b"4000000000"  # bytes
_LOOP_KERNELS: ContextVar[bool] = ContextVar("loop kernels", default=False)
_EMITTERS_OFF = f"--{EMITTERS}=false"
_DEVICE_COUNT = "--xla_force_host_platform_device_count="


@dataclass(frozen=True)
class Runtime:
    """The settings that `tune` made.

    devices: virtual CPU devices.
    emitters_off: whether every CPU compilation leaves the fusion emitters out.
    cache: folder of the persistent compilation cache; None when there is none.
    """

    devices: int
    emitters_off: bool
    cache: Path | None


def tune(devices: int | None = None, cache_dir: str | Path | None = None) -> Runtime:
    """Prepare jax for many replays on this machine; call it before jax computes anything.

    Calling it again with the same settings is harmless.  It also makes Python's cyclic garbage collection rarer, and
    matrix products exact on a GPU unless jax_default_matmul_precision is set.

    Args:
        devices: virtual CPU devices. None keeps a number set by JAX_NUM_CPU_DEVICES or XLA_FLAGS, else takes one per
            core that this process may use. On a GPU they only concern CPU work.
        cache_dir: folder for compiled programs and the flag probe's answer. None takes DROID_JAX_CACHE, else droid_jax
            in the user's cache folder.

    Returns:
        What was set.

    Raises:
        ValueError: devices is below 1.
        RuntimeError: jax is already running on the CPU with other settings.
        OSError: the chosen cache folder cannot be written.
    """
    if devices is not None and devices < 1:
        raise ValueError(f"devices: expected at least 1 virtual CPU device, got {devices}")
    root = _cache_root(cache_dir)
    before_jax()
    import jax

    quiet_cache()
    _leave_shardy()
    if _setting("jax_default_matmul_precision") is None:
        jax.config.update("jax_default_matmul_precision", PRODUCTS)
    gc.set_threshold(*GARBAGE_THRESHOLDS)

    count = devices or _configured_devices() or cores()
    flags = _with_emitters_off(os.environ.get("XLA_FLAGS", ""), root)
    try:
        jax.config.update("jax_num_cpu_devices", count)
    except RuntimeError:  # jax refuses this setting once its backends exist
        _check_running(count, flags)
    else:
        os.environ["XLA_FLAGS"] = flags
    return Runtime(count, _EMITTERS_OFF in flags.split(), _use_cache(root, cache_dir))


def in_full(function: Function) -> Function:
    """The function, traced with exact matrix products (PRODUCTS) where nothing else is set, as without `tune`."""

    @functools.wraps(function)
    def traced(*given: Any, **named: Any) -> Any:
        import jax

        if _setting("jax_default_matmul_precision") is not None:
            return function(*given, **named)
        with jax.default_matmul_precision(PRODUCTS):
            return function(*given, **named)

    return cast(Function, traced)


def compiler_options() -> dict[str, bool]:
    """Options for an outermost `jax.jit(..., compiler_options=...)` of MJX code; {} on a GPU.

    They work with and without `tune` and change no global state.  jax refuses them on a jitted
    function that is called from inside another one.  Starts jax's backend.
    """
    import jax

    if jax.default_backend() != "cpu" or not _option_known():
        return {}
    return {EMITTERS: False}


def with_loop_kernels(function: Function) -> Function:
    """The function, which runs a compiled program; on a CPU each of its loops without library calls is one kernel.

    A program that XLA cannot compile in this way, or a version of jax without this option, is compiled as usual.
    """
    refused = False

    @functools.wraps(function)
    def run(*given: Any) -> Any:
        nonlocal refused
        import jax

        if refused or jax.default_backend() != "cpu" or not _loop_kernels_known():
            return function(*given)
        token = _LOOP_KERNELS.set(True)
        try:
            return function(*given)
        except jax.errors.JaxRuntimeError as error:
            if "UNIMPLEMENTED" not in str(error):
                raise
            refused = True
        finally:
            _LOOP_KERNELS.reset(token)
        return function(*given)

    return cast(Function, run)


@functools.cache
def _loop_kernels_known() -> bool:
    """Whether jax's compile options could be extended; if so, they are inside `with_loop_kernels` from now on.

    XLA reads the bound from a map of its options, which jax can neither set by `compiler_options` nor by name.  So an
    entry is appended to the serialised message; protocol buffers merge it.
    """
    try:
        compiler: Any = importlib.import_module("jax._src.compiler")
        of_jax = compiler.get_compile_options

        def extended(options: Any) -> Any:
            return type(options).ParseFromString(options.SerializeAsString() + _ENTRY)

        known = LOOP_BOUND in extended(of_jax(num_replicas=1, num_partitions=1)).SerializeAsString()
    except (ImportError, AttributeError, TypeError, ValueError, RuntimeError):  # another version of jax
        return False

    @functools.wraps(of_jax)
    def options(*given: Any, **named: Any) -> Any:
        made = of_jax(*given, **named)
        return extended(made) if _LOOP_KERNELS.get() else made

    if known:
        compiler.get_compile_options = options
    return known


def _message(field: int, content: bytes) -> bytes:
    """A field of a protocol buffer that holds bytes, text or a message of fewer than 128 bytes."""
    tag = field << 3 | 2
    return bytes([tag & 127 | 128, tag >> 7] if tag > 127 else [tag]) + bytes([len(content)]) + content


# CompileOptionsProto.executable_build_options.debug_options.xla_backend_extra_options[LOOP_BOUND] = EVERY_LOOP
_ENTRY = _message(3, _message(3, _message(500, _message(1, LOOP_BOUND) + _message(2, EVERY_LOOP))))


def devices_mesh() -> Mesh:
    """All devices of this process on one axis named 'population'."""
    import jax
    import numpy as np

    auto = (jax.sharding.AxisType.Auto,)
    return jax.sharding.Mesh(np.array(jax.local_devices()), ("population",), axis_types=auto)


def first_device() -> Any:
    """This process's first device: mjx takes that of process 0 unless it is given one."""
    import jax

    return jax.local_devices()[0]


def versions() -> dict[str, str]:
    """Versions of Python, this package and what computes for it, and the git commit of a checkout.

    A package that is not installed has no entry.  A commit with uncommitted changes to tracked
    files, results of experiments and benchmarks excepted, ends in "-dirty".
    """
    found = {"python": platform.python_version()}
    for name in ("droid_jax", *PACKAGES):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    commit = git_commit(Path(__file__).resolve().parents[1])
    if commit:
        found["git"] = commit
    return found


def device() -> str:
    """The processors that jax uses, as text: "AMD EPYC, 2 cores" or "2 x NVIDIA H200"."""
    import jax

    each = f"{distributed.count()} processes, each on " if distributed.count() > 1 else ""
    if jax.default_backend() == "cpu":
        count = cores()
        return f"{each}{_cpu_model()}, {count} core{'s' if count != 1 else ''}"
    kinds = [d.device_kind for d in jax.local_devices()]
    return each + ", ".join(f"{kinds.count(k)} x {k}" if kinds.count(k) > 1 else k for k in dict.fromkeys(kinds))


def cores() -> int:
    """Cores this process may keep busy: those it may run on, or fewer where a CPU quota of its cgroup allows fewer."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota()
    return allowed if quota is None else max(1, min(allowed, math.ceil(quota)))


def cpu_quota(proc: Path = Path("/proc/self"), mounted: Path = Path("/sys/fs/cgroup")) -> float | None:
    """Cores' worth of time that the control groups of this process grant; None for no limit, or no cgroups.

    Args:
        proc: folder with the process's file `cgroup`.
        mounted: where version 2, or the controllers of version 1, are mounted.
    """
    try:
        lines = [line.split(":", 2) for line in (proc / "cgroup").read_text().splitlines()]
    except OSError:
        return None
    granted = []
    for _, controllers, path in (line for line in lines if len(line) == 3):
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = mounted / controllers if controllers else mounted
        inside = root / path.lstrip("/")
        # A limit of a group above counts too; in a container the path may be the host's, and the root its own group.
        for group in (inside, *inside.parents):
            if group.is_relative_to(root):
                granted += _granted(group)
    return min(granted, default=None)


def _granted(group: Path) -> list[float]:
    """Cores' worth of time that one control group grants, of version 2 or 1; empty for no limit."""
    with contextlib.suppress(OSError, ValueError):
        quota, period = (group / "cpu.max").read_text().split()
        return [] if quota == "max" else [int(quota) / int(period)]
    with contextlib.suppress(OSError, ValueError, ZeroDivisionError):
        quota, period = ((group / f"cpu.cfs_{name}_us").read_text() for name in ("quota", "period"))
        return [int(quota) / int(period)] if int(quota) > 0 else []
    return []


@functools.cache
def start() -> None:
    """Tune, import jax, and print a line, since it takes seconds; only the first call does anything.

    MJX is imported when it is first used, which fits in plain C do not.
    """
    print("starting jax ...", flush=True)
    tune()
    before_jax()
    check_mujoco()
    importlib.import_module("jax")
    quiet_cache()


def _leave_shardy() -> None:
    """Select jax's older partitioner where the newer one crashes.

    From jax 0.11 on, the compiler crashes on a shard_map over several devices whose function closes over an mjx.Model
    (seen with 0.11.2 on a CPU; not with 0.9, and not on one device).
    """
    import jax

    if tuple(int(part) for part in jax.__version__.split(".")[:2]) >= (0, 11):
        with contextlib.suppress(AttributeError):  # a version of jax without this choice
            jax.config.update("jax_use_shardy_partitioner", False)


def _setting(name: str) -> Any:
    """A jax setting; type checkers do not see them as attributes."""
    import jax

    return getattr(jax.config, name)


def _configured_devices() -> int | None:
    """Number of virtual CPU devices that jax's settings or XLA_FLAGS state; None where they state none."""
    configured = _setting("jax_num_cpu_devices")
    if configured > 0:
        return configured
    chosen = [f for f in os.environ.get("XLA_FLAGS", "").split() if f.startswith(_DEVICE_COUNT)]
    return int(chosen[-1].removeprefix(_DEVICE_COUNT)) if chosen else None


def _with_emitters_off(flags: str, root: Path | None) -> str:
    """XLA_FLAGS with the emitters off, unless the user set the flag or this jaxlib lacks it."""
    if any(f.startswith(f"--{EMITTERS}") for f in flags.split()) or not _flag_known(root):
        return flags
    return f"{flags} {_EMITTERS_OFF}".strip()


def _check_running(devices: int, flags: str) -> None:
    """RuntimeError unless a jax that is already running has these settings (they matter on a CPU only)."""
    import jax

    if jax.default_backend() != "cpu":
        return
    running = jax.local_device_count("cpu")
    wrong = [f"it has {running} CPU device(s) instead of {devices}"] if running != devices else []
    if os.environ.get("XLA_FLAGS", "") != flags:
        wrong.append(f"XLA_FLAGS lacks {_EMITTERS_OFF}")
    if wrong:
        raise RuntimeError(
            f"jax is already running and can no longer be tuned: {' and '.join(wrong)}; call "
            "droid_jax.runtime.tune() before the first jax array or jax.devices() of the program"
        )


def _flag_known(root: Path | None) -> bool:
    """Whether this jaxlib knows the flag; tested once per jaxlib version and cache folder."""
    version = importlib.metadata.version("jaxlib")
    answers = root / f"flag-{EMITTERS}-jaxlib-{version}.json" if root else None
    if answers and answers.is_file():
        with contextlib.suppress(ValueError, OSError):
            return answers.read_text().strip() == "true"
    known = _probe_flag(_EMITTERS_OFF)
    if known is None:
        warnings.warn(f"could not find out whether jaxlib {version} knows {_EMITTERS_OFF}", stacklevel=4)
        return False
    if answers:
        with contextlib.suppress(OSError):  # a full disk: tested again the next time
            write_json(answers, known)
    return known


def _probe_flag(flag: str) -> bool | None:
    """Start jax with one XLA flag in a separate process, since an unknown flag aborts it.

    None when the process failed for another reason.
    """
    environment = {**os.environ, "XLA_FLAGS": flag, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", "import jax; jax.devices()"]
    try:
        probe = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if probe.returncode == 0:
        return True
    return False if "Unknown flag" in probe.stderr else None


@functools.cache
def _option_known() -> bool:
    """Whether this jaxlib's compiler takes the option; an unknown one is an ordinary error here."""
    import jax

    try:
        jax.jit(lambda x: x, compiler_options={EMITTERS: False}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" in str(error):
            return False
        raise
    return True


def _cache_root(cache_dir: str | Path | None) -> Path | None:
    """The cache folder, made if needed; None where the default one cannot be made."""
    chosen = cache_dir or os.environ.get(CACHE_VARIABLE)
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
        root = Path(chosen).expanduser().resolve() if chosen else home / "droid_jax"
        root.mkdir(parents=True, exist_ok=True)
        if not os.access(root, os.W_OK):
            raise PermissionError(f"the cache folder {root} is not writable")
    except (OSError, RuntimeError) as error:  # RuntimeError: the user has no known home folder
        if chosen:
            raise OSError(f"the cache folder {chosen} cannot be written: {error}") from None
        warnings.warn(
            f"working without a compilation cache, every start compiles anew: {error}; set {CACHE_VARIABLE} to a "
            "folder that can be written",
            stacklevel=3,
        )
        return None
    return root


def _use_cache(root: Path | None, cache_dir: str | Path | None) -> Path | None:
    """Switch the persistent compilation cache on; keeps a folder that is already set in jax."""
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    before = _setting("jax_compilation_cache_dir")
    if root is None or (before and cache_dir is None):
        return Path(before) if before else None
    # Compiled CPU programs hold instructions of this processor, which is not part of jax's cache key.
    folder = root / "xla" / _processor_key()
    folder.mkdir(parents=True, exist_ok=True)
    if before and before != str(folder):
        compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)
    return folder


def _cpuinfo(key: str) -> str:
    """First value of a key in Linux's /proc/cpuinfo; "" where there is none."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line.split(":", 1)[1].strip() for line in lines if line.split(":")[0].strip() == key), "")


def _cpu_model() -> str:
    """Name of the processor."""
    return _cpuinfo("model name") or platform.processor() or platform.machine()


def _processor_key() -> str:
    """Short name that differs between processors with different instructions."""
    features = f"{platform.machine()} {_cpu_model()} {_cpuinfo('flags') or _cpuinfo('Features')}"
    return hashlib.sha256(features.encode()).hexdigest()[:12]


def git_commit(checkout: Path) -> str | None:
    """Commit of a checkout; None for an installed package or where git is missing."""
    if not (checkout / ".git").exists():
        return None
    try:
        commit = _git(checkout, "rev-parse", "HEAD")
        # not of the results: one experiment after the other writes them
        elsewhere = (":(exclude)benchmarks/results", ":(exclude)experiments/results")
        changed = _git(checkout, "status", "--porcelain", "--untracked-files=no", "--", ".", *elsewhere)
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}-dirty" if changed else commit


def _git(checkout: Path, *arguments: str) -> str:
    """Output of a read-only git command."""
    command = ["git", "--no-optional-locks", "-C", str(checkout), *arguments]
    run = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    return run.stdout.strip()
