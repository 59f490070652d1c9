"""Atomic writing of files, and checks of saved models."""

from __future__ import annotations

import io
import json
import os
import re
import secrets
import shutil
import sys
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

# Windows has no fcntl and needs no lock: there, a file that is open in another process cannot be removed.
if sys.platform != "win32":
    import fcntl

#: Pattern of a temporary file's name: the name of the target, and a random number.
UNFINISHED = re.compile(r"\.(.+)\.[0-9a-f]{16}\.part")
#: Longer names, in bytes, are replaced by a hash, so that the temporary name stays within the limit of file systems.
LONGEST_NAME = 100
#: A file may unpack to this many bytes, or to this many times its size. SB3 and torch save without compression.
LARGEST_UNFOLDED = 2**26
LARGEST_RATIO = 20


@contextmanager
def replacing(path: str | Path) -> Iterator[io.BufferedRandom]:
    """
    Write a file atomically: to a temporary file beside the target, which replaces the target once it is complete and on
    disk. If writing fails, the old file is kept. A symbolic link is followed, and an existing file keeps its
    permissions.

    Temporary files of killed processes are removed by the next write of the same file, or of one whose name differs
    only in numbers. Those of running processes are locked and are kept.

    :param path: the target
    :return: the file to write to
    """
    target = Path(os.path.realpath(path))
    sweep(target)
    beside, file = _begin(target)
    try:
        with file:
            if target.exists():
                shutil.copymode(target, beside)
            yield file
            file.flush()
            os.fsync(file.fileno())
            if sys.platform != "win32":
                # Replace before the lock is released; otherwise another process could remove the file as a leftover.
                os.replace(beside, target)
        if sys.platform == "win32":  # Windows cannot move an open file
            os.replace(beside, target)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def replace_file(path: str | Path, content: bytes) -> None:
    """
    Write a file atomically, see :func:`replacing`.

    :param path: the target
    :param content: the whole content
    """
    with replacing(path) as file:
        file.write(content)


def _begin(target: Path) -> tuple[Path, io.BufferedRandom]:
    """Open and lock a new temporary file; its path and the file."""
    while True:
        beside = target.with_name(f".{_short(target.name)}.{secrets.token_hex(8)}.part")
        file = open(beside, "x+b")  # noqa: SIM115
        try:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # another process is about to remove it
            file.close()
            continue
        except OSError:  # a file system without locks; leftovers are not removed there either
            return beside, file
        if beside.exists():
            return beside, file
        file.close()


def sweep(target: Path) -> None:
    """
    Remove the temporary files of killed processes.

    :param target: a file; temporary files of it, and of files whose names differ only in numbers, are removed
    """
    kind = _kind(_short(target.name))
    with suppress(OSError):
        for name in os.listdir(target.parent):
            match = UNFINISHED.fullmatch(name)
            if match and _kind(match[1]) == kind:
                _remove_left(target.with_name(name))


def _remove_left(path: Path) -> None:
    """Remove a temporary file, unless a running process is writing it."""
    with suppress(OSError):
        if sys.platform == "win32":
            path.unlink()
            return
        with open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _short(name: str) -> str:
    encoded = os.fsencode(name)
    return name if len(encoded) <= LONGEST_NAME else sha256(encoded).hexdigest()[:32]


def _kind(name: str) -> str:
    return re.sub(r"\d+", "#", name)


def read_description(path: str | Path | io.BufferedIOBase) -> dict[str, Any]:
    """
    Read the JSON part of a file saved by SB3, without unpickling anything, and check that the file is complete.

    :param path: file, with or without ``.zip``, or file-like object
    :return: the content of its JSON part
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, truncated, not a saved model, or unpacks to far more than its size
    """
    file: Any = path
    if isinstance(path, (str, Path)):
        candidates = [Path(path), Path(f"{path}.zip")]
        file = next((candidate for candidate in candidates if candidate.is_file()), None)
        if file is None:
            raise FileNotFoundError(f"no such file: {candidates[0]} (nor {candidates[1]})")
    try:
        with zipfile.ZipFile(file) as archive:
            _check_unfolded_size(path, archive)
            damaged = archive.testzip()
            if damaged is not None:
                raise ValueError(f"{path} is damaged: its member {damaged} has a wrong checksum")
            data = json.loads(archive.read("data"))
            if not isinstance(data, dict):
                raise ValueError(f"{path} is no saved model: its parameters must be a dict; got {data!r}")
            if data.get("algorithm"):
                archive.getinfo("policy.pth"), archive.getinfo("learner.pth")
    except (zipfile.BadZipFile, KeyError, UnicodeDecodeError, json.JSONDecodeError, EOFError, RecursionError) as error:
        raise ValueError(f"{path} is no saved model, or was cut off: {error}") from error
    finally:
        if not isinstance(path, (str, Path)):
            path.seek(0)
    return data


def _check_unfolded_size(path: object, archive: zipfile.ZipFile) -> None:
    """Refuse a file that would fill the memory. Neither SB3 nor torch compresses what it saves."""
    folded, unfolded = 0, 0
    for member in archive.infolist():
        folded, unfolded = folded + member.compress_size, unfolded + member.file_size
    # Members may overlap in the file, so the sum of their sizes may exceed the size of the file.
    assert archive.fp is not None
    folded = min(folded, archive.fp.seek(0, os.SEEK_END))
    _refuse_bomb(path, folded, unfolded)
    for member in archive.infolist():
        if member.filename.endswith(".pth"):
            with archive.open(member) as tensors, suppress(zipfile.BadZipFile), zipfile.ZipFile(tensors) as inner:
                _refuse_bomb(path, member.file_size, sum(part.file_size for part in inner.infolist()))


def _refuse_bomb(path: object, folded: int, unfolded: int) -> None:
    if unfolded > max(LARGEST_UNFOLDED, LARGEST_RATIO * folded):
        raise ValueError(
            f"{path} would unfold from {folded:,} to {unfolded:,} bytes: saved models are not compressed. If you "
            "compressed it yourself, unpack it and pack it again without compression"
        )
