"""Compilation with numba, or plain Python where numba cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

try:
    import numba

    from sb3_knntd.kernels.cache import keep
    from sb3_knntd.kernels.progress import report_compilation

    AVAILABLE = not getattr(numba.config, "DISABLE_JIT", 0)
    #: why numba cannot be used, empty if it can
    REASON = "" if AVAILABLE else "NUMBA_DISABLE_JIT is set"
    report_compilation()
except Exception as error:  # with an unsupported version of NumPy, numba raises other errors than ImportError
    AVAILABLE = False
    REASON = f"{type(error).__name__}: {error}"


def jit(function: Function, forceinline: bool = False) -> Function:
    """
    Compile a function on its first call, without the GIL, and cache the result on disk.

    :param function: the function
    :param forceinline: whether to inline it into compiled functions that call it
    :return: the compiled function, or ``function`` itself without numba
    """
    if not AVAILABLE:
        return function
    # Wrappers take time to compile. Nothing calls these functions from C, nor inlined ones from Python.
    options: dict[str, Any] = {"no_cfunc_wrapper": True, "no_cpython_wrapper": forceinline}
    compiled = numba.njit(nogil=True, forceinline=forceinline, **options)(function)
    keep(compiled)
    return cast(Function, compiled)


def inlined(function: Function) -> Function:
    """
    :func:`jit`, inlined into compiled functions that call it; it cannot be called from Python. For functions called for
    each neighbour: passing a dozen arrays takes longer than reading from them.

    :param function: the function
    :return: the compiled function, or ``function`` itself without numba
    """
    return jit(function, forceinline=True)
