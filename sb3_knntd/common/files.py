"""Files that are whole or not there."""

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

# Windows has no such locks, and needs none: nobody can remove there what another has open.
if sys.platform != "win32":
    import fcntl

#: What an unfinished file is called: after the file that it is to be, and a number of its own.
UNFINISHED = re.compile(r"\.(.+)\.[0-9a-f]{16}\.part")
#: A name of more bytes than this leaves no room for the rest, and a hash stands for it.
LONGEST_NAME = 100
#: A file may unfold to so many bytes, or to so many times its size. SB3 and torch write what they save uncompressed.
LARGEST_UNFOLDED = 2**26
LARGEST_RATIO = 20


@contextmanager
def replacing(path: str | Path) -> Iterator[io.BufferedRandom]:
    """
    Write a file beside its place. It is moved there when it is whole and on the disk; if writing fails, what was there
    stays. A link stays a link, and what it leads to is written; a file that was there keeps its permissions.

    What killed processes have left unfinished is removed by the next that writes the same file, or one whose name
    differs only in numbers. An unfinished file of a process that lives is locked, and left alone.

    :param path: its place
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
                # While it is still locked, or another process could take it for left.
                os.replace(beside, target)
        if sys.platform == "win32":  # Windows does not move what is open
            os.replace(beside, target)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def replace_file(path: str | Path, content: bytes) -> None:
    """
    Write a file, as :func:`replacing` does.

    :param path: its place
    :param content: all of it
    """
    with replacing(path) as file:
        file.write(content)


def _begin(target: Path) -> tuple[Path, io.BufferedRandom]:
    """An unfinished file of this process, and its path."""
    while True:
        beside = target.with_name(f".{_short(target.name)}.{secrets.token_hex(8)}.part")
        file = open(beside, "x+b")  # noqa: SIM115
        try:
            if sys.platform != "win32":
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:  # another process is about to remove it
            file.close()
            continue
        except OSError:  # a file system without locks, where nothing is removed either
            return beside, file
        if beside.exists():
            return beside, file
        file.close()


def sweep(target: Path) -> None:
    """
    Remove what killed processes have left unfinished.

    :param target: the place of a file; those go that were to be this one, or one whose name differs only in numbers
    """
    kind = _kind(_short(target.name))
    with suppress(OSError):
        for name in os.listdir(target.parent):
            match = UNFINISHED.fullmatch(name)
            if match and _kind(match[1]) == kind:
                _remove_left(target.with_name(name))


def _remove_left(path: Path) -> None:
    """Remove a file that no living process is writing."""
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
    Read what a file that SB3 has saved says of its content, without unpickling anything, and check that it is whole.

    :param path: file, with or without ``.zip``, or file-like object
    :return: what JSON holds of it
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if it is damaged, cut off, something else, or unfolds to far more than its size
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
                raise ValueError(f"{path} is damaged: {damaged} in it is not what was written")
            data = json.loads(archive.read("data"))
            if not isinstance(data, dict):
                raise ValueError(f"{path} is no saved model: what it says of its parameters is {data!r}")
            if data.get("algorithm"):
                archive.getinfo("policy.pth"), archive.getinfo("learner.pth")
    except (zipfile.BadZipFile, KeyError, UnicodeDecodeError, json.JSONDecodeError, EOFError, RecursionError) as error:
        raise ValueError(f"{path} is no saved model, or was cut off: {error}") from error
    finally:
        if not isinstance(path, (str, Path)):
            path.seek(0)
    return data


def _check_unfolded_size(path: object, archive: zipfile.ZipFile) -> None:
    """Refuse what would fill the memory: neither SB3 nor torch compress what they save."""
    folded, unfolded = 0, 0
    for member in archive.infolist():
        folded, unfolded = folded + member.compress_size, unfolded + member.file_size
    # Members may share their bytes, so that the sum of what they take says too much.
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
            f"{path} would unfold from {folded:,} to {unfolded:,} bytes: saved models are not compressed. If it is one "
            "of yours that was compressed, unpack it and pack it anew without compression"
        )
