"""The page of a model: one file for the browser, with everything in it."""

from __future__ import annotations

import base64
import csv
import html
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from sb3_knntd.actions.peak import LEAST_CURVATURE, PeakSelector
from sb3_knntd.common.files import replacing
from sb3_knntd.insight.diagnosis import TrainedModel, diagnose
from sb3_knntd.insight.labels import column_names
from sb3_knntd.perception import Lattice, Scattered
from sb3_knntd.perception.bounds import FARTHEST
from sb3_knntd.perception.weights import KernelWeights
from sb3_knntd.plots import Names, names_for, running_median, telling_dims
from sb3_knntd.policies import KNNPolicy

#: Numbers in JavaScript hold no larger integers.
LARGEST_INDEX = 2**53
#: A page with more action values takes a browser too long.
MOST_VALUES = 5_000_000


class Episodes(NamedTuple):
    """
    The episodes of a training run.

    :param steps: number of environment steps at the end of each, shape (n,)
    :param returns: the sum of rewards of each, shape (n,)
    :param env_id: gymnasium id of the environment; empty if unknown
    """

    steps: Sequence[float] | np.ndarray
    returns: Sequence[float] | np.ndarray
    env_id: str = ""


def read_monitor(path: str | Path) -> Episodes:
    """
    :param path: file written by SB3's Monitor
    :return: its episodes
    :raises OSError: if it cannot be read
    :raises ValueError: if it is no such file
    """
    with open(path, encoding="utf-8", newline="") as file:
        try:
            first = file.readline()
            header = json.loads(first[1:]) if first.startswith("#") else {}
            rows = list(csv.DictReader(file))
            lengths, returns = [int(row["l"]) for row in rows], [float(row["r"]) for row in rows]
            env_id = header.get("env_id") or ""
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ValueError(
                f"{path} is no file of SB3's Monitor, which has a line of JSON and then the columns r, l and t: {error}"
            ) from error
    return Episodes(np.cumsum(lengths), returns, "" if env_id == "None" else env_id)


def write_page(
    model: TrainedModel,
    path: str | Path,
    episodes: Episodes | None = None,
    names: Names | None = None,
    env_id: str = "",
) -> None:
    """
    Write a page that shows what a model has learned: value, greedy action and visits over any two dimensions, with
    sliders for all, the neighbours of a state that is clicked, and the findings of :func:`diagnose`. It is one file
    that needs no network.

    :param model: the model
    :param path: the file to write, replaced as a whole
    :param episodes: the episodes of its training, for a learning curve; see :func:`read_monitor`
    :param names: names of the dimensions and actions; by default those of the environment, or numbers
    :param env_id: name of the environment, for the title
    :raises ImportError: if Plotly is not installed
    :raises ValueError: if the weights are a function, the table is too large for a page, or ``names`` do not fit
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise ImportError('pages need Plotly: pip install "sb3-knntd[inspect]"') from error

    content = page_content(model, episodes, names, env_id)
    parts = {
        "{{title}}": html.escape(content["title"]),
        # In a script, "<" could end it.
        "{{content}}": json.dumps(content, allow_nan=False).replace("<", "\\u003c"),
        "{{plotly}}": get_plotlyjs(),
    }
    page = (files("sb3_knntd.insight") / "page.html").read_text(encoding="utf-8")
    for place, text in parts.items():
        before, found, after = page.partition(place)
        assert found, place
        page = before + text + after
    with replacing(path) as file:
        file.write(page.encode())


def page_content(
    model: TrainedModel, episodes: Episodes | None = None, names: Names | None = None, env_id: str = ""
) -> dict[str, Any]:
    """
    :param model: the model
    :param episodes: the episodes of its training
    :param names: names of the dimensions and actions
    :param env_id: name of the environment
    :return: all that the page shows, as JSON
    :raises ValueError: if the weights are a function, the table is too large for a page, or ``names`` do not fit
    """
    policy, names = model.policy, names_for(model, names)
    diagnosis = diagnose(model, names)
    bounds, experience = policy.perceiver.bounds, policy.experience
    env = f" on {env_id}" if env_id else ""
    return {
        "title": f"{type(model).__name__}{env}",
        "facts": [str(diagnosis).splitlines()[0], _facts(policy)],
        "findings": [{"parameter": each.parameter, "message": each.message} for each in diagnosis],
        "observations": list(names.observations),
        "actions": list(names.actions),
        "columns": list(column_names(policy, names)),
        "low": bounds.low.tolist(),
        "high": bounds.high.tolist(),
        "dims": _dims(model),
        "isWhole": not isinstance(model.observation_space, spaces.Box),
        "seen": [experience.low.tolist(), experience.high.tolist()] if experience.n_steps else None,
        "limit": FARTHEST,
        "leastCurvature": LEAST_CURVATURE,
        "k": policy.n_neighbors,
        **_weights(policy),
        "rules": _rules(policy),
        **_points(policy),
        **_table(policy),
        **_action_space(model),
        "episodes": None if episodes is None else _curve(episodes),
    }


def _dims(model: TrainedModel) -> list[int]:
    """The two dimensions that are shown first; the second is -1 if there is one only."""
    if isinstance(model.observation_space, spaces.Box) and model.policy.perceiver.bounds.obs_dim > 1:
        return list(telling_dims(model))
    return [0, 1 if model.policy.perceiver.bounds.obs_dim > 1 else -1]


def _facts(policy: KNNPolicy) -> str:
    points = policy.perceiver.points
    if not isinstance(policy.observation_space, spaces.Box):
        form = "one for each state"
    elif isinstance(points, Lattice):
        form = f"a lattice of {' × '.join(f'{n:,}' for n in points.shape)}"
    else:
        form = "scattered"
    return f"{policy.n_neighbors} nearest of {points.n_points:,} points, {form}"


def _weights(policy: KNNPolicy) -> dict[str, Any]:
    weights = policy.perceiver.weights
    if not isinstance(weights, KernelWeights):
        raise ValueError(
            "weights: a page can be made of a model with named weights only; those of this one are a function"
        )
    return {"weighting": weights.WEIGHTING.name.lower(), "bandwidth": weights.bandwidth}


def _rules(policy: KNNPolicy) -> list[dict[str, Any]]:
    """Where columns are forbidden; JSON has no infinity."""
    rules = policy.rules
    return [
        {
            "low": np.nan_to_num(low).tolist(),
            "high": np.nan_to_num(high).tolist(),
            "columns": np.flatnonzero(columns).tolist(),
        }
        for low, high, columns in zip(
            *(part.cpu().numpy() for part in (rules.low, rules.high, rules.columns)), strict=True
        )
    ]


def _points(policy: KNNPolicy) -> dict[str, Any]:
    points = policy.perceiver.points
    if points.n_points > LARGEST_INDEX:
        raise ValueError(f"points: a page can be made of up to 2^53 points; there are {points.n_points:.3g}")
    if isinstance(points, Lattice):
        return {"axes": [axis.tolist() for axis in points.axes], "places": None}
    assert isinstance(points, Scattered)
    places = points.coordinates(policy.perceiver.bounds).cpu().numpy()
    return {"axes": None, "places": _encoded(places)}


def _table(policy: KNNPolicy) -> dict[str, Any]:
    """The rows of all points, or of those that differ from the initial value."""
    table = policy.table
    with table.lock:
        values, visits = table.entries().double().cpu().numpy(), table.counts().cpu().numpy()
        numbers = table.points()
        points = np.arange(len(values)) if numbers is None else numbers.cpu().numpy()
    told = (visits > 0) | (values != table.initial_value).any(axis=1)
    n_values = int(told.sum()) * values.shape[1]
    if n_values > MOST_VALUES:
        raise ValueError(
            f"a page can show up to {MOST_VALUES:,} action values; this table has {n_values:,}. Draw it with "
            "sb3_knntd.plots.plot_value_function"
        )
    return {
        "rows": _encoded(points[told].astype(np.float64)),
        "values": _encoded(values[told]),
        "visits": _encoded(visits[told].astype(np.float64)),
        "initialValue": table.initial_value,
        "factors": policy.columns.factors.tolist(),
        "averagesValues": policy.selector.averages_values,
    }


def _action_space(model: TrainedModel) -> dict[str, Any]:
    space = model.action_space
    if not isinstance(space, spaces.Box):
        return {"actionPoints": None}
    selector = model.policy.selector
    return {
        "actionPoints": model.policy.columns.points.tolist(),
        "sides": selector.sides.tolist() if isinstance(selector, PeakSelector) else None,
        "actionLow": space.low.reshape(-1).tolist(),
        "actionHigh": space.high.reshape(-1).tolist(),
        "actionIsWhole": bool(np.issubdtype(space.dtype, np.integer)),
    }


def _curve(episodes: Episodes) -> dict[str, Any]:
    window = int(np.clip(len(episodes.returns) // 10, 5, 100))
    returns = np.asarray(episodes.returns, dtype=np.float64)
    return {
        "steps": np.asarray(episodes.steps, dtype=np.float64).tolist(),
        "returns": returns.tolist(),
        "median": running_median(returns, window).tolist(),
        "window": window,
    }


def _encoded(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode()
