"""Planning: value iteration equals exact solutions, held actions and simulated episodes equal plain Python."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_knntd import KNNDyna
from sb3_knntd.kernels import planning as kernels
from sb3_knntd.kernels.planning import OutcomeArrays


def exact_values(rewards, transitions, gamma):
    """
    Policy iteration with linear solves.

    :param rewards: shape (n_states, n_actions)
    :param transitions: shape (n_states, n_actions, n_states), rows sum to less than 1 where an episode can end
    """
    n_states = len(rewards)
    policy = np.zeros(n_states, np.int64)
    while True:
        chosen = transitions[np.arange(n_states), policy]
        values = np.linalg.solve(np.eye(n_states) - gamma * chosen, rewards[np.arange(n_states), policy])
        q = rewards + gamma * transitions @ values
        better = q.argmax(axis=1)
        if (q[np.arange(n_states), better] <= q[np.arange(n_states), policy] + 1e-12).all():
            return q
        policy = better


def random_mdp(seed, n_states=20, n_actions=3, n_successors=4):
    rng = np.random.default_rng(seed)
    transitions = np.zeros((n_states, n_actions, n_states))
    successors = rng.integers(n_states, size=(n_states, n_actions, n_successors))
    weights = rng.dirichlet(np.ones(n_successors), size=(n_states, n_actions))
    for state in range(n_states):
        for action in range(n_actions):
            np.add.at(transitions[state, action], successors[state, action], weights[state, action])
    return rng.normal(size=(n_states, n_actions)), transitions, successors, weights


@pytest.mark.parametrize("seed", range(5))
def test_value_iteration_is_exact(seed):
    rewards, transitions, successors, weights = random_mdp(seed)
    shape = rewards.shape
    outcomes = OutcomeArrays(
        successors=successors.astype(np.int32),
        weights=weights,
        rewards=rewards,
        discounts=np.full(shape, 0.9),
        unknown=np.zeros(shape),
        places=np.empty((*shape, 0)),
        reaches=np.zeros(shape),
    )
    values, best = np.zeros(shape), np.zeros(shape[0])
    known = np.ones(shape, np.bool_)
    kernels.iterate_values(values, best, shape[0], known, outcomes, 0.0, False, 1e-13, 10_000)
    np.testing.assert_allclose(values, exact_values(rewards, transitions, 0.9), atol=1e-10)
    # With what is not known worth more than everything, an action that is not known is the best one.
    known[3, 1] = False
    kernels.iterate_values(values, best, shape[0], known, outcomes, 1000.0, True, 1e-13, 10_000)
    assert values[3].argmax() == 1
    assert best[3] == 1000.0


def tabular_model(env, gamma, add=True):
    """A KNNDyna whose model has seen each transition of a known MDP as often as it is likely."""
    model = KNNDyna(env, gamma=gamma, seed=0)
    planner = model.learner.planner
    table = env.unwrapped.P
    for state, actions in table.items():
        for action, outcomes in actions.items():
            for probability, successor, reward, terminated in outcomes:
                for _ in range(round(6 * probability)):
                    planner.add(
                        np.array([float(state)]), np.array([action]), reward, np.array([float(successor)]), terminated
                    )
    for _ in range(50):
        planner.plan(1, 0)
    return model, table


@pytest.mark.parametrize("env_id", ["FrozenLake-v1", "CliffWalking-v1"])
def test_counts_of_a_known_mdp_give_its_exact_values(env_id):
    env = gym.make(env_id)
    model, table = tabular_model(env, 0.95)
    n_states, n_actions = int(env.observation_space.n), int(env.action_space.n)
    rewards, transitions = np.zeros((n_states, n_actions)), np.zeros((n_states, n_actions, n_states))
    for state, actions in table.items():
        for action, outcomes in actions.items():
            for probability, successor, reward, terminated in outcomes:
                rewards[state, action] += probability * reward
                transitions[state, action, successor] += 0.0 if terminated else probability
    exact = exact_values(rewards, transitions, 0.95)
    # Iteration ends when values move by less than a thousandth of the largest reward.
    largest = np.abs(rewards).max()
    np.testing.assert_allclose(model.policy.q_table.numpy(), exact, atol=0.02 * max(largest, 1.0))
    prediction = model.predict_next(np.array(0), 0)
    assert prediction.known
    assert prediction.reward == pytest.approx(rewards[0, 0])


def test_splitmix_numbers_are_those_of_its_reference():
    """The first outputs for the seed 1234567, published with the reference implementation."""
    state, expected = np.array([1234567], np.uint64), [6457827717110365317, 3203168211198807973]
    for number in expected:
        assert kernels.uniform(state) == (number >> 11) / 2**53
