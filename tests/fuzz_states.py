"""Load mutations of a saved model's tensors and train with them. Run in a separate process, which may crash."""

from __future__ import annotations

import copy
import io
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_envs import DriftEnv, PushEnv

from sb3_knntd import KNNTD, ExA

KINDS: dict[str, tuple[type[KNNTD | ExA], type[DriftEnv], dict[str, Any]]] = {
    "dense": (KNNTD, DriftEnv, {}),
    "hashed": (ExA, PushEnv, {"policy_kwargs": {"table": "hashed"}}),
    "adaptive": (KNNTD, DriftEnv, {"bounds": "adaptive"}),
    "torch": (KNNTD, DriftEnv, {"policy_kwargs": {"compiled": False}}),
}


def mutations(value: Any) -> Iterator[Any]:
    """Invalid replacements of a tensor or number."""
    yield from (None, "word", -1, 10**12, float("nan"), [], {})
    if not isinstance(value, th.Tensor):
        return
    yield th.zeros(())
    yield value[:-1].clone() if len(value) else th.zeros(3)
    yield th.cat([value, value])
    yield value[None].clone()
    yield value.double() if not value.is_floating_point() else value.long()
    yield value[:0].clone()
    yield th.zeros(1, dtype=value.dtype).expand(2**40, *value.shape[1:])
    yield th.zeros(1, dtype=value.dtype).expand(value.shape)
    yield value.to_sparse() if value.dtype != th.bool else value
    yield value.to("meta")
    most = th.finfo(value.dtype) if value.is_floating_point() else None
    if most is not None:
        numbers = [float("nan"), float("inf"), -float("inf"), 1e30, -1e30, most.tiny, -1.0, 0.0, 1e18]
    elif value.dtype == th.bool:
        numbers = [0, 1]
    else:
        numbers = [th.iinfo(value.dtype).min, th.iinfo(value.dtype).max, 0, 1, 3, 100]
        numbers += [-1, -2, -3, 2**31, 2**40] if value.dtype == th.int64 else []
    for number in numbers:
        yield th.full_like(value, number)
        if value.numel():
            one = value.clone()
            one.view(-1)[-1] = number
            yield one


def mutated(state: Any) -> Iterator[tuple[str, Any]]:
    """States with one replaced entry, and the name of the entry."""
    for name, value in state.items():
        if isinstance(value, dict):
            for inner, changed in mutated(value):
                yield f"{name}.{inner}", {**state, name: changed}
        for changed in mutations(value):
            yield f"{name} = {str(changed)[:60]!r}", {**state, name: changed}
        yield f"{name} left out", {key: kept for key, kept in state.items() if key != name}


def main(kind: str, folder: Path) -> None:
    """Try all mutations; each must load and learn, or raise a ValueError."""
    algorithm, env, arguments = KINDS[kind]
    bounds = {} if "bounds" in arguments else {"bounds": (DriftEnv.LOW, DriftEnv.HIGH)}

    def venv() -> DummyVecEnv:
        return DummyVecEnv([env, lambda: env(offset=0.3)])

    algorithm(venv(), points=6, seed=0, **bounds, **arguments).learn(301).save(folder / "model.zip")
    with zipfile.ZipFile(folder / "model.zip") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    n_refused = n_learned = 0
    for part in ("policy.pth", "learner.pth"):
        state = th.load(io.BytesIO(members[part]), weights_only=True)
        for what, other in [*mutated(copy.deepcopy(dict(state))), ("a list", []), ("nothing", {})]:
            print(part, what, flush=True)
            content = io.BytesIO()
            th.save(other, content)
            with zipfile.ZipFile(folder / "other.zip", "w") as archive:
                for name, member in members.items():
                    archive.writestr(name, content.getvalue() if name == part else member)
            try:
                model = algorithm.load(folder / "other.zip", env=venv(), force_reset=False)
            except ValueError:
                n_refused += 1
                continue
            try:
                model.learn(120, reset_num_timesteps=False)
            except FloatingPointError:
                continue
            assert th.isfinite(model.policy.q_table).all()
            n_learned += 1
    print(f"{n_refused} refused, {n_learned} learned", flush=True)
    # Both outcomes must occur, or the test would be vacuous.
    assert n_refused > 100
    assert n_learned > 10


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
