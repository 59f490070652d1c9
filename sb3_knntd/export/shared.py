"""safetensors: the whole policy without pickle, to share. Reading it executes nothing from the file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th

from sb3_knntd.common.files import replace_file
from sb3_knntd.common.plain import class_name, decode, encode
from sb3_knntd.export.frozen import Exportable
from sb3_knntd.perception import Lattice

#: Key of the description, and the version of its form.
KEY, VERSION = "sb3_knntd", 1
#: The tensor that holds scattered points.
PLACES = "perceiver.points.places"


def write_safetensors(policy: Exportable, path: Path) -> list[Path]:
    """
    Write the tensors of the policy, and its class and arguments as JSON in the file's metadata.
    :func:`~sb3_knntd.load_policy` reads it.

    :param policy: the policy
    :param path: file to write
    :return: the file
    :raises ValueError: if an argument is a function or another object of Python
    """
    from safetensors.torch import save

    policy.frozen().kernel_weights("safetensors")
    arguments = dict(policy._get_constructor_parameters())
    if not isinstance(policy.perceiver.points, Lattice) and not isinstance(arguments["points"], str):
        # They are among the tensors, also those that were added.
        del arguments["points"]
    try:
        described = {name: encode(value) for name, value in arguments.items()}
    except TypeError as error:
        raise ValueError(f"format='safetensors' holds numbers, arrays and spaces, but {error}") from error
    description = {"version": VERSION, "policy": class_name(type(policy)), "arguments": described}
    tensors = {name: tensor.cpu().contiguous() for name, tensor in policy.state_dict().items()}
    replace_file(path, save(tensors, {KEY: json.dumps(description)}))
    return [path]


def read_safetensors(path: Path) -> tuple[str, dict[str, Any], Mapping[str, th.Tensor]]:
    """
    :param path: a file that :func:`write_safetensors` has written, or an untrusted one
    :return: name of the policy's class, see :func:`~sb3_knntd.common.plain.class_name`; its arguments; its tensors
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, or holds no policy of this package
    :raises ImportError: if safetensors is not installed
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise ImportError("load_policy needs safetensors: pip install 'sb3-knntd[export]'") from error

    if not path.is_file():
        raise FileNotFoundError(f"no such file: {path}")
    try:
        with safe_open(path, framework="pt") as file:
            content = (file.metadata() or {}).get(KEY)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no dict
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path} is no safetensors file, or was cut off: {error}") from error
    try:
        description = json.loads(content or "null")
    except (json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: the description of the policy is damaged: {error}") from error
    if not isinstance(description, dict) or not isinstance(description.get("arguments"), dict):
        raise ValueError(f"{path} holds no policy of sb3-knntd: there is no description of one in its metadata")
    version = description.get("version")
    if version != VERSION:
        raise ValueError(f"{path} is written in form {version!r}; this version of sb3-knntd reads {VERSION}")
    arguments = {name: decode(value) for name, value in description["arguments"].items()}
    if PLACES in tensors and "points" not in arguments:
        arguments["points"] = tensors[PLACES].numpy()
    return str(description.get("policy")), arguments, tensors
