"""Compile the kernels now, so that no later run has to wait for it: ``python -m sb3_knntd.kernels``."""

from __future__ import annotations

import torch as th

from sb3_knntd import KNNTD


def main() -> None:
    """Learn and predict one step with each type of table."""
    for dtype in (th.float64, th.float32):
        model = KNNTD("MountainCar-v0", policy_kwargs={"dtype": dtype}).learn(1)
        model.predict(model.observation_space.sample(), deterministic=True)


if __name__ == "__main__":
    main()
