"""A fit in mjlab: an event term that gives every world its own draw of the parameters.

    import mjlab_terms, mujoco                              # beside fitted.json and apply_fit.py

    robot = EntityCfg(spec_fn=lambda: mujoco.MjSpec.from_file("fitted.xml"), ...)
    cfg.events["fit"] = mjlab_terms.fitted("robot", draws=4096)             # once, when the environment starts
    cfg.events["fit"] = mjlab_terms.fitted("robot", draws=4096, mode="reset")    # again with every episode

The term writes the numbers of `apply_fit.batch` into the worlds' models, with those that MuJoCo derives from them.  It
needs torch, mujoco and numpy, which mjlab needs too.  The laws of fitted.json are not fields of a model: they need your
own actuator.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import apply_fit  # pyright: ignore[reportMissingImports]
import torch  # pyright: ignore[reportMissingImports]
from mjlab.managers.event_manager import EventTermCfg  # pyright: ignore[reportMissingImports]

FITTED = Path(__file__).with_name("fitted.json")


def fitted(entity: str = "robot", draws: int = 1024, seed: int = 0, mode: str = "startup") -> EventTermCfg:
    """Return the event term of a fitted robot.

    Args:
        entity: name of the robot in mjlab's scene.
        draws: number of draws of the Gaussian; world k starts with draw k modulo `draws`.
        seed: of the draws.
        mode: "startup", or "reset": each world gets a random one of the draws at the start of an episode.
    """
    return EventTermCfg(func=FittedDraws, mode=mode, params={"entity": entity, "draws": draws, "seed": seed})


class FittedDraws:
    """Writes draws of a fit into the models of the worlds; mjlab constructs it with the term's configuration."""

    def __init__(self, cfg: EventTermCfg, env: Any) -> None:
        fit, params = apply_fit.load(FITTED), cfg.params
        fields = apply_fit.batch(env.sim.mj_model, fit, params["draws"], params["seed"], prefix=f"{params['entity']}/")
        worlds = {name: rows for name, rows in fields.items() if hasattr(env.sim.wp_model, name)}
        if missing := sorted({row["field"] for row in fit["table"]} & (fields.keys() - worlds.keys())):
            raise ValueError(f"mujoco_warp has no {', '.join(missing)}, which the fit writes")
        self.model_fields = tuple(worlds)  # mjlab gives each world its own rows of these
        self.again, self.draws = cfg.mode == "reset", params["draws"]
        self.rows = {name: torch.as_tensor(rows, dtype=torch.float32) for name, rows in worlds.items()}

    def __call__(self, env: Any, env_ids: torch.Tensor | None, **_: Any) -> None:
        """Give each of these worlds, or all for None, a draw."""
        ids = torch.arange(env.num_envs) if env_ids is None else env_ids.cpu().long()
        pick = torch.randint(self.draws, ids.shape) if self.again else ids % self.draws
        for name, rows in self.rows.items():
            field = getattr(env.sim.model, name)
            field[ids.to(env.device)] = rows[pick].to(env.device)
