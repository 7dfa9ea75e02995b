"""A fit in mjlab: an event term that gives every world a draw of its own.

    import mjlab_terms, mujoco                              # beside fitted.json and apply_fit.py

    robot = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file("fitted.xml"), ...)
    cfg.events["fit"] = mjlab_terms.fitted("robot", draws=4096)             # once, when the environment starts
    cfg.events["fit"] = mjlab_terms.fitted("robot", draws=4096, mode="reset")    # again with every episode

The term writes the numbers of `apply_fit.batch` into the worlds' models, with what MuJoCo derives from them.  It needs
what mjlab has: torch, mujoco and numpy.  The laws of fitted.json are in no field: they need an actuator of your own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import apply_fit  # pyright: ignore[reportMissingImports]
import torch  # pyright: ignore[reportMissingImports]
from mjlab.managers.event_manager import EventTermCfg  # pyright: ignore[reportMissingImports]

FITTED = Path(__file__).with_name("fitted.json")


def fitted(entity: str = "robot", draws: int = 1024, seed: int = 0, mode: str = "startup") -> EventTermCfg:
    """The event term of a fitted robot.

    Args:
        entity: name of the robot in mjlab's scene.
        draws: of the Gaussian, shared out among the worlds; world k starts with draw k modulo `draws`.
        seed: of the draws.
        mode: "startup", or "reset": each world whose episode begins gets any of them.
    """
    return EventTermCfg(func=FittedDraws, mode=mode, params={"entity": entity, "draws": draws, "seed": seed})


class FittedDraws:
    """Writes draws of a fit into the models of the worlds; mjlab makes it with the term's configuration."""

    def __init__(self, cfg: EventTermCfg, env: Any) -> None:
        fit, params = apply_fit.load(FITTED), cfg.params
        fields = apply_fit.batch(env.sim.mj_model, fit, params["draws"], params["seed"], prefix=f"{params['entity']}/")
        worlds = {name: rows for name, rows in fields.items() if hasattr(env.sim.wp_model, name)}
        if lost := sorted({row["field"] for row in fit["table"]} & (fields.keys() - worlds.keys())):
            raise ValueError(f"mujoco_warp has no {', '.join(lost)}, which the fit writes")
        self.model_fields = tuple(worlds)  # mjlab gives each world rows of its own in these
        self.again, self.draws = cfg.mode == "reset", params["draws"]
        self.rows = {name: torch.as_tensor(rows, dtype=torch.float32) for name, rows in worlds.items()}

    def __call__(self, env: Any, env_ids: torch.Tensor | None, **_: Any) -> None:
        """Give these worlds, or all, a draw each."""
        ids = torch.arange(env.num_envs) if env_ids is None else env_ids.cpu().long()
        pick = torch.randint(self.draws, ids.shape) if self.again else ids % self.draws
        for name, rows in self.rows.items():
            field = getattr(env.sim.model, name)
            field[ids.to(env.device)] = rows[pick].to(env.device)
