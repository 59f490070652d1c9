"""Saving and loading of filters."""

from __future__ import annotations

import pathlib
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.save_util import is_json_serializable, load_from_zip_file, save_to_zip_file

from sb3_knntd.common.files import read_description, replacing
from sb3_knntd.common.plain import encodable, objects_for
from sb3_knntd.filters.table import DeltaTable, FilterArguments

#: Marks a file as that of a filter.
CONTENT = "sb3_knntd filter"


def save_table(path: str | pathlib.Path, table: DeltaTable, training: bool) -> None:
    """
    Save what a filter has learned, and its parameters. The file is written under another name and renamed: an
    interruption leaves a complete file.

    :param path: file, with ``.zip`` added if it has no suffix
    :param table: the table
    :param training: whether the filter is training
    """
    target = pathlib.Path(path)
    if not target.suffix:
        target = target.with_name(f"{target.name}.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    data: dict[str, Any] = {
        "content": CONTENT,
        "arguments": table.arguments.to_dict(),
        "observation_space": table.observation_space,
        "action_space": table.action_space,
        "bounds_from_space": table.bounds_from_space,
        "training": training,
    }
    data["plain"] = encodable({name: value for name, value in data.items() if not is_json_serializable(value)})
    with replacing(target) as file:
        save_to_zip_file(file, data, {"filter": table.state_dict()})


def load_table(
    path: str | pathlib.Path, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], trusted: bool
) -> tuple[DeltaTable, bool]:
    """
    :param path: file
    :param observation_space: observation space of the environment to filter
    :param action_space: action space of it
    :param trusted: whether to unpickle objects in the file that are not plain data
    :return: the table, and whether the filter was training
    :raises ValueError: if the file is damaged, holds something else, or is for other spaces; without ``trusted`` also
        if it holds functions, which are pickled
    """
    description = read_description(path)
    if description.get("content") != CONTENT:
        raise ValueError(f"{path} holds no filter. Models are loaded by their own class, e.g. KNNTD.load")
    objects = None if trusted else objects_for(path, description)
    data, params, _ = load_from_zip_file(path, custom_objects=objects, device="cpu")
    assert data is not None
    saved = data["observation_space"], data["action_space"]
    table = DeltaTable(*saved, FilterArguments(**data["arguments"]), data["bounds_from_space"])
    table.check_spaces(observation_space, action_space)
    state: dict[str, Any] = params["filter"]  # type: ignore[assignment]
    try:
        table.load_state_dict(state)
    except RuntimeError as error:  # torch raises it for bounds that do not fit
        raise ValueError(f"{path}: {error}") from error
    return table, data["training"]
