"""
The time of a decision and the size of policies that are exported as C. Needs a C compiler.

    python -m benchmarks.export [--compiler gcc] [--repeats 9] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from benchmarks.machine import describe
from sb3_knntd import KNNTD, ExA

#: Number of environment steps that a policy learns for.
STEPS = 20_000
#: Number of different observations, and how often they are decided on in one measurement.
N_OBSERVATIONS, ROUNDS = 4096, 100

PROGRAM = """
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include "policy.h"

static policy_real observations[{n}][POLICY_OBSERVATION_SIZE];

int main(void)
{{
    struct timespec start, end;
    policy_real sum = 0;
    int i, round;
    if (fread(observations, sizeof observations, 1, stdin) != 1)
        return 1;
    clock_gettime(CLOCK_MONOTONIC, &start);
    for (round = 0; round < {rounds}; ++round)
        for (i = 0; i < {n}; ++i)
            sum += (policy_real)policy_action(observations[i]);
    clock_gettime(CLOCK_MONOTONIC, &end);
    printf("%.3f %g", ((double)(end.tv_sec - start.tv_sec) * 1e9 + (double)(end.tv_nsec - start.tv_nsec))
           / ({rounds}.0 * {n}.0), (double)sum);
    return 0;
}}
"""


class Row(NamedTuple):
    """
    One line of the table.

    :param policy: the policy
    :param options: of the export
    :param nanoseconds: median time of a decision
    :param low: shortest time
    :param high: longest time
    :param size: bytes of code and data
    :param predict: median time of ``predict`` in Python, nanoseconds
    """

    policy: str
    options: str
    nanoseconds: float
    low: float
    high: float
    size: int
    predict: float


def policies() -> dict[str, KNNTD | ExA]:
    """The trained models, by description."""
    box = gym.make("MountainCar-v0").observation_space
    places = np.random.default_rng(0).uniform(box.low, box.high, (300, 2))
    return {
        "MountainCar-v0, 20 x 20 points": KNNTD("MountainCar-v0", points=20, seed=0).learn(STEPS),
        "MountainCar-v0, 300 scattered points": KNNTD("MountainCar-v0", points=places, seed=0).learn(STEPS),
        "CartPole-v1, 9 x 9 x 9 x 9 points": KNNTD("CartPole-v1", seed=0).learn(STEPS),
        "Pendulum-v1, 20 x 20 x 20 points, ExA": ExA("Pendulum-v1", seed=0).learn(STEPS),
    }


def measure(model: KNNTD | ExA, name: str, compiler: str, repeats: int, **options: Any) -> Row:
    """
    :param model: a trained model
    :param name: its description
    :param compiler: command of the C compiler
    :param repeats: number of measurements
    :param options: of the export
    :return: the time of a decision and the size
    """
    observations = model.policy.frozen().sample_observations(N_OBSERVATIONS)
    with tempfile.TemporaryDirectory() as folder:
        source, _ = model.policy.export(Path(folder) / "policy", "c", **options)
        main, program, built = (source.with_name(name) for name in ("main.c", "program", "policy.o"))
        main.write_text(PROGRAM.format(n=N_OBSERVATIONS, rounds=ROUNDS))
        subprocess.run([compiler, "-std=c99", "-O2", "-c", source, "-o", built], check=True)
        subprocess.run([compiler, "-std=c99", "-O2", main, built, "-lm", "-o", program], check=True)
        given = observations.astype(np.float32 if options.get("precision") == "float" else np.float64).tobytes()
        times, predictions = [], []
        for _ in range(repeats):
            answer = subprocess.run([program], input=given, capture_output=True, check=True).stdout
            times.append(float(answer.split()[0]))
            start = time.perf_counter()
            for observation in observations[:1000]:
                model.predict(observation, deterministic=True)
            predictions.append((time.perf_counter() - start) * 1e6)
        listed = subprocess.run(["size", built], capture_output=True, check=True, text=True).stdout.splitlines()[1]
    return Row(
        name,
        ", ".join(options.values()),
        statistics.median(times),
        min(times),
        max(times),
        int(listed.split()[3]),
        statistics.median(predictions),
    )


def main() -> None:
    """Print a table of all policies."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compiler", default="gcc", help="command of the C compiler (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=9, help="number of measurements (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="file for the table and the machine")
    args = parser.parse_args()
    rows = [
        measure(model, name, args.compiler, args.repeats, precision=precision, rows=rows)
        for name, model in policies().items()
        for precision, rows in (("double", "all"), ("float", "changed"))
    ]
    print("| policy | numbers, rows | a decision, ns | range | bytes | `predict`, ns |\n|---|---|---|---|---|---|")
    for row in rows:
        times = f"{row.nanoseconds:,.0f} | {row.low:,.0f} to {row.high:,.0f}"
        print(f"| {row.policy} | {row.options} | {times} | {row.size:,} | {row.predict:,.0f} |")
    told = subprocess.run([args.compiler, "--version"], capture_output=True, check=True, text=True).stdout
    machine = describe() | {"compiler": told.splitlines()[0]}
    print("\n" + ", ".join(f"{key} {value}" for key, value in machine.items()))
    if args.json:
        args.json.write_text(json.dumps({"rows": [row._asdict() for row in rows], "machine": machine}, indent=2) + "\n")


if __name__ == "__main__":
    main()
