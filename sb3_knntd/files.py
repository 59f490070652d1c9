"""Files that are whole or not there."""

from __future__ import annotations

import io
import json
import os
import secrets
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(path: Path) -> Iterator[io.BufferedWriter]:
    """
    Write a file beside its place. It is moved there when it is whole and on the disk; if writing fails, what was there
    stays.

    :param path: its place
    :return: the file to write to
    """
    beside = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    try:
        with open(beside, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def replace_file(path: Path, content: bytes) -> None:
    """
    Write a file, as :func:`replacing` does.

    :param path: its place
    :param content: all of it
    """
    with replacing(path) as file:
        file.write(content)


def read_description(path: str | Path | io.BufferedIOBase) -> dict[str, Any]:
    """
    Read what a file that SB3 has saved says of its content, without unpickling anything, and check that it is whole.

    :param path: file, with or without ``.zip``, or file-like object
    :return: what JSON holds of it
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, cut off, or something else
    """
    file: Any = path
    if isinstance(path, (str, Path)):
        candidates = [Path(path), Path(f"{path}.zip")]
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            raise FileNotFoundError(f"no such file: {candidates[0]} (nor {candidates[1]})")
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{path} is damaged: {damaged} in it is not what was written")
            data = json.loads(archive.read("data"))
            if not isinstance(data, dict):
                raise ValueError(f"{path} is no saved model: what it says of its parameters is {data!r}")
            if data.get("algorithm"):
                archive.getinfo("policy.pth"), archive.getinfo("learner.pth")
    except (zipfile.BadZipFile, KeyError, json.JSONDecodeError, EOFError) as error:
        raise ValueError(f"{path} is no saved model, or was cut off: {error}") from error
    finally:
        if not isinstance(path, (str, Path)):
            path.seek(0)
    return data
