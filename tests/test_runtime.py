"""Settings before jax starts: seen from fresh processes, since each can be tuned only once."""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from droid_jax import runtime

ROOT = Path(__file__).resolve().parents[1]
PLAIN = ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES", "JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL")
# With the fusion emitters XLA compiles a fused expression to a kernel called "..._fusion_kernel".
COMPILE = """
def compiled(**options):
    import jax, jax.numpy as jnp
    f = jax.jit(lambda x: jnp.sin(x) * jnp.cos(x) + jnp.tanh(x[::-1]), **options)
    return f.lower(jnp.ones(64)).compile()
def fused(**options):
    return b"fusion_kernel" in compiled(**options).runtime_executable().serialize()
"""


def fresh(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new Python without this session's jax settings, on the CPU."""
    kept = {k: v for k, v in os.environ.items() if k not in PLAIN}
    kept |= {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run([sys.executable, "-c", code], env=kept, capture_output=True, text=True, timeout=120)


def answer(code: str, **environment: str) -> dict:
    """The JSON object that code prints in a new Python."""
    run = fresh(code, **environment)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def test_importing_sets_nothing():
    seen = answer(
        "import os, sys, json; before = dict(os.environ); import droid_jax.runtime\n"
        "print(json.dumps({'jax': 'jax' in sys.modules, 'same': before == dict(os.environ)}))"
    )
    assert seen == {"jax": False, "same": True}


def test_tune_settles_devices_flag_and_cache(tmp_path):
    code = f"""{COMPILE}
import json, os
from droid_jax.runtime import tune
first = tune(devices=3, cache_dir={str(tmp_path)!r})
import jax
seen = dict(count=jax.device_count(), fused=fused(), folder=jax.config.jax_compilation_cache_dir)
seen |= dict(again=tune(devices=3, cache_dir={str(tmp_path)!r}) == first, settled=first.devices)
seen |= dict(kept=tune() == first, off=first.emitters_off, cache=str(first.cache))
try:
    tune(devices=2)
except RuntimeError as error:
    seen["error"] = str(error)
print(json.dumps(seen))
"""
    seen = answer(code)
    assert (seen["count"], seen["settled"]) == (3, 3)
    assert seen["off"] and not seen["fused"]
    assert seen["again"] and seen["kept"]
    assert Path(seen["folder"]).is_relative_to(tmp_path) and seen["folder"] == seen["cache"]
    assert "3 CPU device(s) instead of 2" in seen["error"] and "before the first jax array" in seen["error"]


def test_untuned_jax_keeps_the_emitters_and_the_option_drops_them(tmp_path):
    code = f"""{COMPILE}
import json
from droid_jax.runtime import compiler_options, tune
seen = dict(plain=fused(), option=fused(compiler_options=compiler_options()), options=compiler_options())
try:
    tune(devices=1, cache_dir={str(tmp_path)!r})
except RuntimeError as error:
    seen["error"] = str(error)
print(json.dumps(seen))
"""
    seen = answer(code)
    assert seen["plain"] and not seen["option"]
    assert seen["options"] == {"xla_cpu_use_fusion_emitters": False}
    assert "XLA_FLAGS lacks --xla_cpu_use_fusion_emitters=false" in seen["error"]


def test_the_users_own_choices_stay(tmp_path):
    code = """
import json
from droid_jax.runtime import tune
settled = tune()
import jax
folder = jax.config.jax_compilation_cache_dir
print(json.dumps([jax.device_count(), settled.devices, settled.emitters_off, folder]))
"""
    flags = "--xla_force_host_platform_device_count=5 --xla_cpu_use_fusion_emitters=true"
    mine = str(tmp_path / "mine")
    variables = {"DROID_JAX_CACHE": str(tmp_path), "JAX_COMPILATION_CACHE_DIR": mine, "XLA_FLAGS": flags}
    assert answer(code, **variables) == [5, 5, False, mine]


def test_a_second_process_finds_the_program_compiled(tmp_path):
    code = f"""{COMPILE}
import json
from droid_jax.runtime import compiler_options, tune
tune(cache_dir={str(tmp_path)!r})
import jax
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
options, seen = compiler_options(), []
jax.monitoring.register_event_listener(lambda name, **_: seen.append(name))
compiled(compiler_options=options)
print(json.dumps(dict(hits=seen.count("/jax/compilation_cache/cache_hits"))))
"""
    first, second = fresh(code), fresh(code)
    assert json.loads(first.stdout)["hits"] == 0
    assert json.loads(second.stdout)["hits"] > 0
    assert second.stderr == ""


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of loops are XLA's on a CPU")
def test_a_loop_becomes_one_kernel_inside_with_loop_kernels():
    def program(x: jax.Array) -> str:
        def loop(x):
            return jax.lax.fori_loop(0, 50, lambda i, y: jnp.sin(y) * 2.0 + y, x)

        return jax.jit(loop).lower(x).compile().as_text()

    large = jnp.ones((16, 64))  # XLA does the same by itself for a kilobyte
    assert "xla_cpu_small_call" not in program(large)
    assert "xla_cpu_small_call" in runtime.with_loop_kernels(program)(large)
    assert "xla_cpu_small_call" not in program(large)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="kernels of loops are XLA's on a CPU")
def test_what_xla_cannot_compile_into_a_kernel_is_compiled_as_usual():
    tried = list[bool]()

    def run(number: int) -> int:
        tried.append(runtime._LOOP_KERNELS.get())
        if tried[-1]:
            raise jax.errors.JaxRuntimeError("UNIMPLEMENTED: Fusion kind not implemented on CPU")
        return number + 1

    kernels = runtime.with_loop_kernels(run)
    assert (kernels(1), kernels(2), tried) == (2, 3, [True, False, False])

    def fail() -> None:
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")

    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        runtime.with_loop_kernels(fail)()
    assert not runtime._LOOP_KERNELS.get()


def test_an_unknown_flag_is_recognised_without_harm():
    assert runtime._probe_flag("--xla_no_such_flag_at_all=false") is False


def test_the_flag_is_probed_once_per_cache(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(runtime, "_probe_flag", lambda flag: asked.append(flag) or False)
    assert [runtime._flag_known(tmp_path) for _ in range(3)] == [False] * 3
    assert asked == ["--xla_cpu_use_fusion_emitters=false"]
    assert runtime._with_emitters_off("--a=1", tmp_path) == "--a=1"
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "another")
    runtime._flag_known(tmp_path)
    assert len(asked) == 2


def test_an_unclear_probe_is_not_remembered(tmp_path, monkeypatch):
    monkeypatch.setattr(runtime, "_probe_flag", lambda flag: None)
    with pytest.warns(UserWarning, match="could not find out"):
        assert runtime._flag_known(tmp_path) is False
    assert list(tmp_path.iterdir()) == []


def test_cache_folder_from_argument_variable_and_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("DROID_JAX_CACHE", raising=False)
    assert runtime._cache_root(None) == tmp_path / "home" / "droid_jax"
    monkeypatch.setenv("DROID_JAX_CACHE", str(tmp_path / "variable"))
    assert runtime._cache_root(None) == tmp_path / "variable"
    assert runtime._cache_root(tmp_path / "argument") == tmp_path / "argument"


def test_a_cache_that_cannot_be_made(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        runtime._cache_root(tmp_path / "file" / "cache")
    monkeypatch.delenv("DROID_JAX_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.warns(UserWarning, match="without a compilation cache"):
        assert runtime._cache_root(None) is None


def test_no_devices_is_refused():
    with pytest.raises(ValueError, match=r"devices: expected at least 1 .* got 0"):
        runtime.tune(devices=0)


def test_mesh_spans_all_devices_of_the_process():
    mesh = runtime.devices_mesh()
    assert mesh.axis_names == ("population",)
    assert list(mesh.devices) == jax.local_devices()
    assert mesh.axis_types == (jax.sharding.AxisType.Auto,)
    rows = PartitionSpec("population")
    total = jax.shard_map(
        lambda x: jax.lax.psum(x.sum(), "population"), mesh=mesh, in_specs=rows, out_specs=PartitionSpec()
    )
    x = jnp.arange(4.0 * len(mesh.devices))
    np.testing.assert_allclose(jax.jit(total)(x), x.sum())


def test_products_are_exact_unless_the_user_decided(tmp_path):
    """In separate processes, because the setting is that of the whole program."""
    code = "from droid_jax import runtime; runtime.tune(); import jax; print(jax.config.jax_default_matmul_precision)"
    for given, expected in ({}, "highest"), ({"JAX_DEFAULT_MATMUL_PRECISION": "tensorfloat32"}, "tensorfloat32"):
        environment = {**os.environ, runtime.CACHE_VARIABLE: str(tmp_path), **given}
        run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
        assert run.stdout.split()[-1] == expected


def test_no_cpu_options_on_another_backend(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert runtime.compiler_options() == {}


def test_versions_name_what_is_installed():
    found = runtime.versions()
    assert found["python"] == sys.version.split()[0]
    assert found["jax"] == jax.__version__
    assert found["numpy"] == np.__version__
    assert found["mujoco"] == importlib.metadata.version("mujoco")
    assert "no-such-package" not in found


def test_git_commit_of_a_checkout(tmp_path):
    assert runtime.git_commit(tmp_path) is None

    def git(*arguments: str) -> str:
        who = ("-c", "user.name=n", "-c", "user.email=n@example.org", "-c", "commit.gpgsign=false")
        run = subprocess.run(["git", *who, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return run.stdout.strip()

    try:
        git("init", "--quiet")
    except FileNotFoundError:
        pytest.skip("git is not installed")
    assert runtime.git_commit(tmp_path) is None  # no commit yet
    result = tmp_path / "experiments" / "results" / "found.json"
    result.parent.mkdir(parents=True)
    for path in (tmp_path / "file", result):
        path.write_text("1")
    git("add", ".")
    git("commit", "--quiet", "--no-verify", "-m", "one")
    commit = runtime.git_commit(tmp_path)
    assert commit == git("rev-parse", "HEAD") and re.fullmatch(r"[0-9a-f]{40,64}", commit)
    result.write_text("2")
    assert runtime.git_commit(tmp_path) == commit
    (tmp_path / "file").write_text("2")
    assert runtime.git_commit(tmp_path) == f"{commit}-dirty"


def test_device_has_a_name(monkeypatch):
    class Card:
        device_kind = "NVIDIA H200"

    monkeypatch.setattr(jax, "local_devices", lambda: [Card(), Card()])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert runtime.device() == "2 x NVIDIA H200"
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    monkeypatch.setattr(runtime, "cores", lambda: 1)
    assert re.fullmatch(r".+, 1 core", runtime.device())


def test_quiet_drops_only_the_two_lines():
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.raises(KeyError), runtime.quiet():
        print("kept")
        print("Failed to import warp: No module named 'warp'")
        print("Failed to import mujoco_warp: No module named 'warp'")
        print("Failed to import warp: a driver is too old")
        raise KeyError
    assert printed.getvalue() == "kept\nFailed to import warp: a driver is too old\n"


def test_mjx_is_imported_without_a_word():
    run = fresh("from droid_jax.quiet import import_mjx; assert import_mjx().put_model")
    assert (run.returncode, run.stdout) == (0, "")


# ----- quotas


def control_groups(tmp_path: Path, memberships: str, files: dict[str, str]) -> tuple[Path, Path]:
    """A made-up /proc/self and /sys/fs/cgroup."""
    proc, mounted = tmp_path / "proc", tmp_path / "cgroup"
    proc.mkdir()
    (proc / "cgroup").write_text(memberships)
    for name, text in files.items():
        (mounted / name).parent.mkdir(parents=True, exist_ok=True)
        (mounted / name).write_text(text)
    return proc, mounted


V1 = "12:pids:/docker/a\n4:cpu,cpuacct:/docker/a\n1:name=systemd:/docker/a\n"


@pytest.mark.parametrize(
    ("memberships", "files", "expected"),
    [
        ("0::/user/app\n", {"user/app/cpu.max": "150000 100000\n"}, 1.5),
        ("0::/user/app\n", {"user/app/cpu.max": "max 100000\n"}, None),
        ("0::/user/app\n", {"user/app/cpu.max": "max 100000\n", "user/cpu.max": "200000 100000\n"}, 2.0),
        ("0::/user/app\n", {"user/app/cpu.max": "400000 100000\n", "user/cpu.max": "50000 100000\n"}, 0.5),
        ("0::/\n", {"cpu.max": "100000 100000\n"}, 1.0),  # a container with a view of its own
        ("0::/docker/of/the/host\n", {"cpu.max": "300000 100000\n"}, 3.0),  # one with the host's
        (V1, {"cpu,cpuacct/cpu.cfs_quota_us": "250000\n", "cpu,cpuacct/cpu.cfs_period_us": "100000\n"}, 2.5),
        (V1, {"cpu,cpuacct/docker/a/cpu.cfs_quota_us": "-1\n", "cpu,cpuacct/docker/a/cpu.cfs_period_us": "1\n"}, None),
        (V1, {"pids/docker/a/cpu.max": "1 100\n"}, None),
        ("0::/user\n", {"user/cpu.max": "nonsense\n"}, None),
        ("nonsense\n", {}, None),
    ],
)
def test_a_quota_of_control_groups(tmp_path: Path, memberships: str, files: dict[str, str], expected: float | None):
    assert runtime.cpu_quota(*control_groups(tmp_path, memberships, files)) == expected


@pytest.mark.parametrize(("quota", "expected"), [(None, 8), (1.5, 2), (0.2, 1), (3.0, 3), (64.0, 8)])
def test_a_quota_counts_as_cores_do(monkeypatch: pytest.MonkeyPatch, quota: float | None, expected: int):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.setattr(runtime, "cpu_quota", lambda: quota)
    assert runtime.cores() == expected


def test_without_control_groups_there_is_no_quota(tmp_path: Path):
    assert runtime.cpu_quota(tmp_path, tmp_path) is None


# ----- quiet

FIRST_COST = """
{first}
import droid_jax
droid_jax.tune(cache_dir={cache!r})
import jax
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
import jax.numpy as jnp
import droid_jax.cost.cost
found = []
jax.monitoring.register_event_listener(lambda name, **_: found.append(name.endswith("compilation_cache/cache_hits")))
jax.block_until_ready(jax.jit(lambda x: jnp.sin(x) @ x.T)(jnp.ones((8, 8))))
assert any(found) is {warm}
"""


@pytest.mark.slow
@pytest.mark.parametrize("first", ["", "import jax", "import jax.numpy; import mujoco", "import droid_jax.model.step"])
def test_it_prints_nothing_even_with_a_warm_cache(tmp_path: Path, first: str):
    """XLA prints 2 kB about every program that it loads, whether jax or this package was imported first."""
    for warm in (False, True):
        done = fresh(FIRST_COST.format(first=first, cache=str(tmp_path), warm=warm))
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_other_messages_of_the_cache_are_not_hidden(tmp_path: Path):
    """Unknown messages and the program's own output are printed."""
    code = """
import os, re, sys
from droid_jax.quiet import _OF_THE_CACHE, _without
with _without(_OF_THE_CACHE):
    os.write(2, b"E1 cpu_aot_loader.cc:220] X. Target machine feature +prefer-no-gather is not  supported on the h\\n")
    os.write(2, b"E1 cpu_aot_loader.cc:220] X. Target machine feature +avx512f is not  supported on the host\\n")
    print("mine", file=sys.stderr)
os.write(2, b"behind\\n")
"""
    done = fresh(code)
    assert done.stderr.splitlines() == [
        "E1 cpu_aot_loader.cc:220] X. Target machine feature +avx512f is not  supported on the host",
        "mine",
        "behind",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", ["cost.cost", "model.step", "policy.train", "policy.parallel", "synthetic.robot", "discrepancy.missing"]
)
def test_importing_a_module_prints_nothing(module: str):
    done = fresh(f"import droid_jax.{module}")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_matplotlib_without_a_home_prints_nothing():
    done = fresh("import droid_jax.report.style", HOME="/dev/null", XDG_CONFIG_HOME="", XDG_CACHE_HOME="")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_mjx_is_imported_in_one_place():
    """Whoever imports it first sees its two lines about warp."""
    package = ROOT / "droid_jax"
    own = re.compile(r"^\s*(from|import) mujoco.*\bmjx", re.MULTILINE)
    found = {path.name for path in package.rglob("*.py") if own.search(path.read_text())}
    assert found == {"quiet_mjx.py", "quiet.py"}
