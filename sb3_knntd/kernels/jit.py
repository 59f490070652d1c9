"""numba's compiler, or, where it cannot be used, none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

try:
    import numba

    from sb3_knntd.kernels.cache import keep

    AVAILABLE = not getattr(numba.config, "DISABLE_JIT", 0)
    #: why numba cannot be used, empty if it can
    REASON = "" if AVAILABLE else "NUMBA_DISABLE_JIT is set"
except Exception as error:  # a numba that does not fit the installed NumPy raises more than ImportError
    AVAILABLE = False
    REASON = f"{type(error).__name__}: {error}"


def jit(function: Function, forceinline: bool = False) -> Function:
    """
    Compile on the first call, keep the result on disk, and let other threads run meanwhile.

    :param function: to be compiled
    :param forceinline: whether compiled functions have it in place of their calls
    :return: the compiled function, or ``function`` itself without numba
    """
    if not AVAILABLE:
        return function
    compiled = numba.njit(nogil=True, forceinline=forceinline)(function)
    keep(compiled)
    return cast(Function, compiled)


def inlined(function: Function) -> Function:
    """
    As :func:`jit`, in place of every call by compiled functions. For what is called for each neighbour: handing over a
    dozen arrays takes longer than a glance into them.

    :param function: to be compiled
    :return: the compiled function, or ``function`` itself without numba
    """
    return jit(function, forceinline=True)
