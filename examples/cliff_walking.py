"""
Tabular SARSA and Q-learning on the cliff of Sutton and Barto's "Reinforcement Learning" (example 6.6).

    python examples/cliff_walking.py

Q-learning learns the shortest path, along the edge, and keeps falling off while it explores. SARSA learns a safer path
further away, and has higher returns during training.
"""

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd import KNNTD

ROWS, COLUMNS = 4, 12
ARROWS = np.array(list("↑→↓←"))


def greedy_path(model: KNNTD, env: VecEnv) -> list[int]:
    """
    :param model: a model trained on CliffWalking
    :param env: one environment
    :return: the states that the greedy policy visits, including the initial state
    """
    state, done = env.reset(), False
    path = [int(state[0])]
    while not done and len(path) <= ROWS * COLUMNS:
        action, _ = model.predict(state, deterministic=True)
        state, _, dones, infos = env.step(action)
        done = bool(dones[0])
        path.append(int(infos[0]["terminal_observation"] if done else state[0]))
    return path


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
        path = greedy_path(model, model.get_env())

        cells = np.full(ROWS * COLUMNS, "·")
        cells[37:47] = "▒"
        best = model.policy.q_table.argmax(dim=1).numpy()
        cells[path[:-1]] = ARROWS[best[path[:-1]]]
        cells[47] = "G"
        print(f"{target}: greedy path of {len(path) - 1} steps, mean training return {np.mean(returns):.1f}")
        print("\n".join("  " + " ".join(row) for row in cells.reshape(ROWS, COLUMNS)), end="\n\n")


if __name__ == "__main__":
    main()
