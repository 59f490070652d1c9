"""A filter as a file."""

from __future__ import annotations

import pathlib
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.save_util import is_json_serializable, load_from_zip_file, save_to_zip_file

from sb3_knntd.common.files import read_description, replacing
from sb3_knntd.common.plain import encodable, objects_for
from sb3_knntd.filters.table import Arguments, DeltaTable

#: What a file says that it holds.
CONTENT = "sb3_knntd filter"


def save_table(path: str | pathlib.Path, table: DeltaTable, training: bool) -> None:
    """
    Save what a filter has learned, and its parameters. It is written beside the old file and renamed, so that
    whatever interrupts it leaves a whole file.

    :param path: file, with ``.zip`` added if it has no suffix
    :param table: what was learned
    :param training: whether it was learning
    """
    target = pathlib.Path(path)
    if not target.suffix:
        target = target.with_name(f"{target.name}.zip")
    target.parent.mkdir(parents=True, exist_ok=True)
    data: dict[str, Any] = {
        "content": CONTENT,
        "arguments": table.arguments._asdict(),
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
    :param observation_space: of the environment to be filtered
    :param action_space: likewise
    :param trusted: whether to unpickle what it holds besides data
    :return: what was learned, and whether it was learning
    :raises ValueError: if the file is damaged, holds something else, or is of other spaces; without trust also if it
        holds functions, which are there only as pickles
    """
    description = read_description(path)
    if description.get("content") != CONTENT:
        raise ValueError(f"{path} holds no filter. Models are loaded by their own class, e.g. KNNTD.load")
    objects = None if trusted else objects_for(path, description)
    data, params, _ = load_from_zip_file(path, custom_objects=objects, device="cpu")
    assert data is not None
    saved = data["observation_space"], data["action_space"]
    table = DeltaTable(*saved, Arguments(**data["arguments"]), data["bounds_from_space"])
    table.check_spaces(observation_space, action_space)
    state: dict[str, Any] = params["filter"]  # type: ignore[assignment]
    try:
        table.load_state_dict(state)
    except RuntimeError as error:  # torch's, of bounds that do not fit
        raise ValueError(f"{path}: {error}") from error
    return table, data["training"]
