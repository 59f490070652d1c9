"""numba's cache on disk, without which everything works as well, and only takes longer."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from hashlib import sha256
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

DIGEST_SIZE = sha256().digest_size


class _Complaint:
    """Tells once in a process why compiling takes long."""

    def __init__(self) -> None:
        self._is_made = False

    def __call__(self, why: str) -> None:
        if not self._is_made:
            self._is_made = True
            warnings.warn(
                f"the kernels are compiled anew, which takes up to a minute: {why}. Set NUMBA_CACHE_DIR to a folder "
                "that can be written to",
                RuntimeWarning,
                stacklevel=2,
            )


complain = _Complaint()


class CheckedFile(IndexDataCacheFile):
    """Files with a digest: machine code of which a bit is another would be run all the same."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        # What numba has written without digests is of another version, and not damaged.
        self._version = f"{numba.__version__} with digests"

    def _dump(self, obj: Any) -> bytes:
        # Behind, where pickle does not look.
        content: bytes = super()._dump(obj)
        return content + sha256(content).digest()

    def _load_data(self, name: str) -> Any:
        with open(self._data_path(name), "rb") as file:
            content = file.read()
        if sha256(content[:-DIGEST_SIZE]).digest() != content[-DIGEST_SIZE:]:
            raise ValueError(f"{self._data_path(name)} is damaged")
        return super()._load_data(name)


class KernelCache(FunctionCache):
    """
    Keeps compiled functions on disk. What cannot be read or written there is compiled anew.

    :param function: whose results it keeps
    :raises RuntimeError: if there is no folder that can be written to
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = CheckedFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """
        :param sig: types of the arguments
        :param target_context: numba's
        :return: the compiled function, ``None`` if it has to be compiled
        """
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged pickle raises anything
            complain(f"numba's cache in {self.cache_path} cannot be read ({_told(error)})")
            try:
                # Or what is compiled now could not be kept either.
                self.flush()
            except OSError:
                self.disable()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """
        :param sig: types of the arguments
        :param data: the compiled function
        """
        try:
            super().save_overload(sig, data)
        except OSError as error:
            complain(f"numba's cache in {self.cache_path} cannot be written ({_told(error)})")


class NoCache(NullCache):
    """Says that there is none when something is compiled."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """
        :param sig: types of the arguments
        :param target_context: numba's
        """
        folder = os.environ.get("NUMBA_CACHE_DIR")
        complain(f"numba has no folder for its cache{f', NUMBA_CACHE_DIR is {folder!r}' if folder else ''}")


def keep(dispatcher: Any) -> None:
    """
    Have numba keep what it compiles, if it can.

    :param dispatcher: numba's, of a function
    """
    try:
        dispatcher._cache = KernelCache(dispatcher.py_func)
    except RuntimeError:  # there is no folder that numba may write to
        dispatcher._cache = NoCache()


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
