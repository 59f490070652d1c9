"""
Tabular SARSA and Q-learning on the cliff of Sutton and Barto's "Reinforcement Learning" (example 6.6).

    python examples/cliff_walking.py

Q-learning learns the shortest way, along the edge, from which its exploration keeps falling; SARSA learns to keep its
distance, and earns more while it explores.
"""

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd import KNNTD

ROWS, COLUMNS = 4, 12
ARROWS = np.array(list("↑→↓←"))


def greedy_route(model: KNNTD, env: VecEnv) -> list[int]:
    """
    :param model: a model of CliffWalking
    :param env: one environment
    :return: the states that the greedy policy goes through, the start first
    """
    state, done = env.reset(), False
    route = [int(state[0])]
    while not done and len(route) <= ROWS * COLUMNS:
        action, _ = model.predict(state, deterministic=True)
        state, _, dones, infos = env.step(action)
        done = bool(dones[0])
        route.append(int(infos[0]["terminal_observation"] if done else state[0]))
    return route


def main() -> None:
    for target in ("sarsa", "q_learning"):
        model = KNNTD(
            "CliffWalking-v1",
            target=target,
            trace_decay=0.0,
            gamma=1.0,
            exploration_initial_eps=0.1,
            exploration_final_eps=0.1,
            seed=0,
        )
        model.learn(30_000)
        returns = [episode["r"] for episode in model.ep_info_buffer]
        route = greedy_route(model, model.get_env())

        cells = np.full(ROWS * COLUMNS, "·")
        cells[37:47] = "▒"
        best = model.policy.q_table.argmax(dim=1).numpy()
        cells[route[:-1]] = ARROWS[best[route[:-1]]]
        cells[47] = "G"
        print(f"{target}: greedy route of {len(route) - 1} steps, return while training {np.mean(returns):.1f}")
        print("\n".join("  " + " ".join(row) for row in cells.reshape(ROWS, COLUMNS)), end="\n\n")


if __name__ == "__main__":
    main()
