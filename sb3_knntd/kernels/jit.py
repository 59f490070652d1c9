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


def jit(function: Function) -> Function:
    """
    Compile a function on its first call, without the GIL, and cache the result on disk.

    :param function: the function
    :return: the compiled function, or ``function`` itself without numba
    """
    return _compiled(function)


def helper(function: Function) -> Function:
    """
    :func:`jit`, for functions that are called from compiled functions only: this takes less time to compile.

    :param function: the function
    :return: the compiled function, or ``function`` itself without numba
    """
    return _compiled(function, no_cpython_wrapper=True)


def inlined(function: Function) -> Function:
    """
    :func:`helper`, inlined into the functions that call it. For functions called for each neighbour: passing a dozen
    arrays takes longer than reading from them.

    :param function: the function
    :return: the compiled function, or ``function`` itself without numba
    """
    return _compiled(function, no_cpython_wrapper=True, forceinline=True)


def _compiled(function: Function, **options: Any) -> Function:
    if not AVAILABLE:
        return function
    # Nothing calls these functions from C either.
    options |= {"nogil": True, "no_cfunc_wrapper": True}
    compiled = numba.njit(**options)(function)
    keep(compiled)
    return cast(Function, compiled)
