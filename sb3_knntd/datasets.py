"""Logged data as transitions: Minari datasets, SB3's replay buffers, NPZ and CSV files, and controllers at work."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from sb3_knntd.common.checks import check_integer, shown
from sb3_knntd.learners import Transitions

#: The columns of a log, with Minari's names. Observations and actions may consist of several.
COLUMNS = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
#: Texts of truth values in a CSV file.
TRUTHS = {"true": 1.0, "false": 0.0}


def read_transitions(
    dataset: Any,
    observation_space: spaces.Space[Any],
    action_space: spaces.Space[Any],
    columns: Mapping[str, str | Sequence[str]] | None = None,
) -> Transitions:
    """
    :param dataset: a Minari dataset, or the name of a local one; an SB3 ReplayBuffer; a ``.npz`` or ``.csv`` file; or a
        mapping of names to arrays, such as a dict or a pandas DataFrame
    :param observation_space: of the environment
    :param action_space: of the environment
    :param columns: for files and mappings: the columns that hold the observations, actions, rewards,
        next_observations, terminations and truncations; by default those with these names. Observations and actions may
        be several columns, one for each dimension. Without next observations, a row is followed by the next one
    :return: the transitions in temporal order, actions as of the environment
    :raises ValueError: if the data have another form or do not fit the spaces
    """
    if isinstance(dataset, str) and Path(dataset).suffix not in (".npz", ".csv"):
        dataset = _load_minari(dataset)
    if columns is not None and (hasattr(dataset, "iterate_episodes") or isinstance(dataset, ReplayBuffer)):
        raise ValueError(
            f"columns must be None for a {type(dataset).__name__}, which names its own; got {shown(columns)}"
        )
    if hasattr(dataset, "iterate_episodes"):
        parts = list(_from_minari(dataset))
    elif isinstance(dataset, ReplayBuffer):
        parts = list(_from_buffer(dataset))
    else:
        parts = [_from_log(_read_log(dataset), columns or {})]
    if not parts or not sum(len(part.rewards) for part in parts):
        raise ValueError(f"dataset holds no transitions: {shown(dataset)}")
    joined = Transitions(*map(np.concatenate, zip(*parts, strict=True)))
    return _fitted(joined, observation_space, action_space)


def record(env: VecEnv, act: Callable[[np.ndarray], np.ndarray], n_steps: int) -> tuple[Transitions, float]:
    """
    Run a controller, from the start of an episode.

    :param env: the environments
    :param act: from observations to actions of the environments
    :param n_steps: number of steps over all environments
    :return: the transitions, and the mean return of the episodes that ended (NaN if none did)
    """
    rows: list[list[tuple[Any, ...]]] = [[] for _ in range(env.num_envs)]
    returns, running = [], np.zeros(env.num_envs)
    observations: Any = env.reset()
    for _ in range(-(-n_steps // env.num_envs)):
        actions = np.asarray(act(observations)).reshape(env.num_envs, *(env.action_space.shape or ()))
        after: Any
        after, rewards, dones, infos = env.step(actions.astype(env.action_space.dtype))
        running += rewards
        for i, info in enumerate(infos):
            last = info["terminal_observation"] if dones[i] else after[i]
            terminated = bool(dones[i]) and not info.get("TimeLimit.truncated", False)
            rows[i].append((observations[i], actions[i], rewards[i], last, terminated, bool(dones[i])))
            if dones[i]:
                returns.append(running[i])
                running[i] = 0.0
        observations = after
    parts = [Transitions(*map(np.array, zip(*each, strict=True))) for each in rows]
    for part in parts:
        part.ended[-1] = True
    joined = Transitions(*map(np.concatenate, zip(*parts, strict=True)))
    return joined, float(np.mean(returns)) if returns else float("nan")


def _load_minari(name: str) -> Any:
    try:
        import minari
    except ImportError as error:
        raise ImportError(
            f'dataset: {name!r} is taken to be a Minari dataset, which needs: pip install "sb3-knntd[data]". Files end '
            "in .npz or .csv"
        ) from error
    return minari.load_dataset(name)


def _from_minari(dataset: Any) -> Iterator[Transitions]:
    for episode in dataset.iterate_episodes():
        n = len(episode.rewards)
        observations = np.asarray(episode.observations)
        if observations.dtype == object or len(observations) != n + 1:
            raise ValueError(
                f"dataset: observations must be arrays of {n + 1} rows; episode {episode.id} of {n} steps has "
                f"{type(episode.observations).__name__} of {len(observations)}"
            )
        ended = episode.terminations | episode.truncations
        # An episode whose recording was stopped goes on, but not in this dataset.
        ended[-1] = True
        yield Transitions(
            observations[:-1],
            np.asarray(episode.actions),
            episode.rewards,
            observations[1:],
            episode.terminations.astype(bool),
            ended.astype(bool),
        )


def _from_buffer(buffer: ReplayBuffer) -> Iterator[Transitions]:
    size = buffer.buffer_size if buffer.full else buffer.pos
    order = (np.arange(size) + buffer.pos * buffer.full) % buffer.buffer_size
    if buffer.optimize_memory_usage and buffer.full:
        # The first row holds the observation after the last step.
        order = order[1:]
    for env in range(buffer.n_envs):
        ended = buffer.dones[order, env].astype(bool)
        terminated = ended & ~buffer.timeouts[order, env].astype(bool)
        ended[-1:] = True
        if buffer.optimize_memory_usage:
            after = buffer.observations[(order + 1) % buffer.buffer_size, env]
        else:
            after = buffer.next_observations[order, env]
        observations = buffer.observations[order, env]
        yield Transitions(
            observations, buffer.actions[order, env], buffer.rewards[order, env], after, terminated, ended
        )


def _read_log(dataset: Any) -> Mapping[str, Any]:
    if isinstance(dataset, Mapping):
        return dataset
    if hasattr(dataset, "columns") and hasattr(dataset, "__getitem__"):
        return {str(name): np.asarray(dataset[name]) for name in dataset.columns}
    if not isinstance(dataset, str | Path):
        raise ValueError(
            "dataset must be a Minari dataset or its name, an SB3 ReplayBuffer, a .npz or .csv file, or a mapping of "
            f"names to arrays; got {shown(dataset)}"
        )
    path = Path(dataset)
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    if path.suffix != ".csv":
        raise ValueError(f"dataset: a file must be a .npz or a .csv; got {path}")
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    try:
        numbers = [[_number(text.strip().lower()) for text in row] for row in rows if row]
        table = np.array(numbers, dtype=np.float64).reshape(len(numbers), len(header))
    except ValueError as error:
        raise ValueError(f"{path}: a CSV log must hold a line of names, and then numbers: {error}") from error
    return {name.strip(): table[:, i] for i, name in enumerate(header)}


def _number(text: str) -> float:
    return TRUTHS[text] if text in TRUTHS else float(text)


def _from_log(log: Mapping[str, Any], columns: Mapping[str, str | Sequence[str]]) -> Transitions:
    unknown = set(columns) - set(COLUMNS)
    if unknown:
        raise ValueError(f"columns must be of {', '.join(COLUMNS)}; got {', '.join(map(repr, sorted(unknown)))}")

    def column(name: str) -> np.ndarray:
        given = columns.get(name, name)
        names = [given] if isinstance(given, str) else list(given)
        for each in names:
            if each not in log:
                raise ValueError(
                    f"columns: the {name} are not in the data: there is no {each!r} among {', '.join(map(repr, log))}. "
                    f"Name them, columns={{{name!r}: ...}}"
                )
        arrays = [np.asarray(log[each]) for each in names]
        return arrays[0] if isinstance(given, str) else np.stack(arrays, axis=1)

    def is_given(name: str) -> bool:
        return name in columns or name in log

    observations, actions, rewards = (column(name) for name in COLUMNS[:3])
    n = len(rewards)
    terminated, truncated = (
        column(name).astype(bool) if is_given(name) else np.zeros(n, bool) for name in ("terminations", "truncations")
    )
    for name, array in zip(COLUMNS, (observations, actions, rewards, observations, terminated, truncated), strict=True):
        if len(array) != n:
            raise ValueError(f"columns: there are {len(array)} {name} for {n} rewards")
    ended = terminated | truncated
    if is_given("next_observations"):
        after, usable = column("next_observations"), np.ones(n, bool)
    else:
        # Where a log does not say how an episode went on, the last step cannot be learned from.
        after, usable = np.concatenate((observations[1:], observations[-1:])), terminated | ~truncated
        usable[-1:] = terminated[-1:]
        ended[:-1] |= ~usable[1:]
    ended[np.flatnonzero(usable)[-1:]] = True
    arrays = observations, actions, rewards, after, terminated, ended
    return Transitions(*(array[usable] for array in arrays))


def _fitted(
    transitions: Transitions, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
) -> Transitions:
    """Check the sizes of observations and actions, and convert both to the types of the spaces."""
    n = len(transitions.rewards)
    arrays = {"observations": transitions.observations, "next_observations": transitions.next_observations}
    shaped: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        shape = observation_space.shape or ()
        if array.size != n * int(np.prod(shape)):
            raise ValueError(f"{name} must have shape {(n, *shape)}, as in the observation space; got {array.shape}")
        shaped[name] = array.reshape(n, *shape)
    shape = action_space.shape or ()
    actions = transitions.actions
    if actions.size != n * int(np.prod(shape)):
        raise ValueError(f"actions must have shape {(n, *shape)}, as in the action space; got {actions.shape}")
    actions = actions.reshape(n, *shape)
    if isinstance(action_space, spaces.Discrete) and not np.issubdtype(actions.dtype, np.integer):
        fractions = actions[actions != np.rint(actions)]
        if len(fractions):
            check_integer("actions: a Discrete action", float(fractions[0]), int(action_space.start))
        actions = actions.astype(np.int64)
    return transitions._replace(actions=actions, rewards=np.asarray(transitions.rewards, np.float64), **shaped)
