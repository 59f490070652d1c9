"""The torch step on a GPU: memory bandwidth with 4096 environments and 10^6 points."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from benchmarks.rows import Row
from sb3_knntd.actions.exploration import EpsilonGreedy
from sb3_knntd.actions.selection import MeanValueSelector
from sb3_knntd.common.random_stream import RandomStream
from sb3_knntd.kernels.selection import Target
from sb3_knntd.learners import TorchLearner, UpdateConfig
from sb3_knntd.policies import KNNPolicy
from sb3_knntd.q_table import DenseTable

N_ENVS, POINTS, K = 4096, 1000, 16


def bandwidth(work: Callable[[], Any], n_bytes: float, repeats: int) -> list[float]:
    """
    :param work: the function to measure, which runs on the device
    :param n_bytes: lower bound of the bytes that it moves
    :param repeats: number of measurements
    :return: bytes per second of each measurement
    """
    work()
    rates = []
    for _ in range(repeats):
        start, end = (th.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        work()
        end.record()
        end.synchronize()
        rates.append(n_bytes / (start.elapsed_time(end) / 1e3))
    return rates


def against_copy(repeats: int) -> list[Row]:
    """
    Measure the bandwidth of perception (every distance is written once and read once by the selection) and of a whole
    step (which also reads and writes rows of the table), as a share of the bandwidth of a device-to-device copy.

    :param repeats: number of measurements
    :return: one row for each
    """
    device = th.device("cuda")
    box = spaces.Box(-1.0, 1.0, (2,), np.float32)
    policy = KNNPolicy(box, spaces.Discrete(3), n_neighbors=K, points=POINTS, search="brute").to(device)
    selector = MeanValueSelector(policy.columns, Target.SARSA, EpsilonGreedy(), random_ties=True)
    config = UpdateConfig(gamma=0.99, normalized=True, accumulating=False, reset_other_actions=False)
    stream = RandomStream((N_ENVS, 2, selector.n_uniforms))
    assert isinstance(policy.table, DenseTable)
    learner = TorchLearner(
        policy.perceiver, policy.table, selector, stream, N_ENVS, config, policy.experience, one_step=True
    )
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (N_ENVS, 2)).astype(np.float32)
    learner.begin(observations, 0.1)
    on_device = th.from_numpy(observations).to(device)

    block = th.empty(2**28, dtype=th.float64, device=device)
    other = th.empty_like(block)
    copy = statistics.median(bandwidth(lambda: other.copy_(block), 2 * block.numel() * 8, repeats))

    distances = 2 * N_ENVS * POINTS**2 * 8
    rows = 3 * N_ENVS * K * 3 * 8
    answers = rng.random(N_ENVS), np.zeros(N_ENVS, bool), {}, (0.1, 0.0, 0.1)
    reached = {
        f"perception of {N_ENVS} observations among 10^6 points, device='cuda'": bandwidth(
            lambda: policy.perceiver(on_device), distances, repeats
        ),
        f"a whole step of {N_ENVS} environments, device='cuda'": bandwidth(
            lambda: learner.step(observations, *answers), distances + rows, repeats
        ),
    }
    return [
        Row.of(
            f"{what}: its bandwidth over that of a copy",
            [rate / copy for rate in rates],
            ">= 0",
            f"{statistics.median(rates) / 1e9:.0f} / {copy / 1e9:.0f} GB/s on {th.cuda.get_device_name()}",
        )
        for what, rates in reached.items()
    ]
