"""Disk cache of compiled functions. Without it, each process compiles the kernels again."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from hashlib import sha256
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

DIGEST_SIZE = sha256().digest_size


class _WarnOnce:
    """Warns once per process why the kernels must be compiled."""

    def __init__(self) -> None:
        self._has_warned = False

    def __call__(self, reason: str) -> None:
        if not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"the kernels are compiled anew, which takes up to a minute: {reason}. Set NUMBA_CACHE_DIR to a folder "
                "that can be written to",
                RuntimeWarning,
                stacklevel=2,
            )


warn_once = _WarnOnce()


class CheckedFile(IndexDataCacheFile):
    """Cache files with a checksum, so that damaged machine code is not executed."""

    def __init__(self, **arguments: Any) -> None:
        super().__init__(**arguments)
        # Treat files written by numba without checksums as another version, not as damaged.
        self._version = f"{numba.__version__} with digests"

    def _dump(self, obj: Any) -> bytes:
        # pickle ignores trailing data.
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
    Disk cache of a compiled function. If it cannot be read or written, the function is compiled again.

    :param function: the function
    :raises RuntimeError: if no folder is writable
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
        :param target_context: see numba
        :return: the compiled function; ``None`` if it is not in the cache
        """
        try:
            return super().load_overload(sig, target_context)
        except Exception as error:  # a damaged pickle can raise any error
            warn_once(f"numba's cache in {self.cache_path} cannot be read ({_describe(error)})")
            try:
                # Reset the damaged index, so that the newly compiled function can be saved.
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
            warn_once(f"numba's cache in {self.cache_path} cannot be written ({_describe(error)})")


class NoCache(NullCache):
    """Stands in for a cache that is not available. Warns when a function is compiled."""

    def load_overload(self, sig: Any, target_context: Any) -> None:
        """
        :param sig: types of the arguments
        :param target_context: see numba
        """
        folder = os.environ.get("NUMBA_CACHE_DIR")
        warn_once(f"numba has no folder for its cache{f', NUMBA_CACHE_DIR is {folder!r}' if folder else ''}")


def keep(dispatcher: Any) -> None:
    """
    Cache a function on disk, if a folder is writable.

    :param dispatcher: the function, compiled by numba
    """
    try:
        dispatcher._cache = KernelCache(dispatcher.py_func)
    except RuntimeError:  # no folder is writable
        dispatcher._cache = NoCache()


def _describe(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
