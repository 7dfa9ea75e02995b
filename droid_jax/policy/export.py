"""Export a policy for a robot: npz, ONNX and the control loop in one folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from droid_jax.errors import needs
from droid_jax.files import POLICY
from droid_jax.policy import control
from droid_jax.policy.control import ACTIONS, ARM, LAYOUT, OBSERVED, Policy, arrays
from droid_jax.storage import npz_bytes, write_own

OPSET = 17
CLOSE = 2e-5  # largest difference of an action (of -1 .. 1) between two float32 programs of one policy
OUTPUTS = (
    *(f"target of joint {i}, in units of reach from where the joint is" for i in range(1, ARM + 1)),
    *(f"target of the {side} finger, -1 shut, 1 open" for side in ("left", "right")),
)


def export(folder: Path, policy: Policy) -> float:
    """Write policy.npz, policy.onnx and control.py; returns the largest difference of an action between ONNX and JAX.

    Raises ValueError if onnx or onnxruntime is not installed, the two differ by more than `CLOSE`, or the folder has a
    file of one of these names that `export` did not write or that was changed since.
    """
    needs("export needs", "export", "onnx", "onnxruntime")
    model = to_onnx(policy)
    error = difference(policy, model)
    if not error <= CLOSE:
        raise ValueError(f"the ONNX policy differs from the JAX policy by {error:.2g} in an action: it is not written")
    code = Path(control.__file__).read_bytes()
    write_own(folder, {POLICY: npz_bytes(arrays(policy)), "policy.onnx": model, "control.py": code})
    return error


def to_onnx(policy: Policy) -> bytes:
    """The policy as an ONNX model: observation [N, 23] float32 -> action [N, 9] in -1 .. 1, with the normalisation.

    The model's metadata describe the observation and the action, and hold the period [s], reach [rad] and width [m].
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray) -> str:
        constants.append(numpy_helper.from_array(value.astype(np.float32), name))
        return name

    def node(kind: str, name: str, *inputs: str) -> str:
        nodes.append(helper.make_node(kind, list(inputs), [name]))
        return name

    x = node("Sub", "centred", "observation", constant("mean", policy.mean))
    x = node("Div", "normalised", x, constant("std", policy.std))
    last = len(policy.weights) - 1
    for k, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        columns = slice(ACTIONS) if k == last else slice(None)  # the others are deviations, used in training only
        inputs = constant(f"weight_{k}", weight[:, columns]), constant(f"bias_{k}", bias[columns])
        x = node("Gemm", f"layer_{k}", x, *inputs)
        x = node("Tanh", "action" if k == last else f"hidden_{k}", x)
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in (("observation", OBSERVED), ("action", ACTIONS))
    ]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], constants)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, producer_name="droid_jax", opset_imports=[opset], ir_version=9)
    helper.set_model_props(model, _notes(policy))
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _notes(policy: Policy) -> dict[str, str]:
    numbers: dict[str, Any] = {"period, s": policy.interface.period, "reach, rad": policy.interface.reach,
                               "width, m": policy.interface.width}  # fmt: skip
    return {
        "observation": json.dumps(LAYOUT),
        "action": json.dumps(OUTPUTS),
        **{name: repr(float(value)) for name, value in numbers.items()},
    }


def difference(policy: Policy, model: bytes) -> float:
    """Largest difference of an action between the ONNX policy and the JAX policy, over 1000 random observations."""
    import onnxruntime

    rng = np.random.default_rng(0)
    observations = np.float32(policy.mean + 2.0 * policy.std * rng.normal(size=(1000, OBSERVED)))
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    found: Any = session.run(["action"], {"observation": observations})[0]
    with jax.default_matmul_precision("highest"):
        expected = policy.act(jnp.asarray(observations), jnp)
    return float(np.max(np.abs(found - np.asarray(expected))))
