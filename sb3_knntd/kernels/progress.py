"""Says on the standard error what is being compiled, as this takes a while on first use."""

from __future__ import annotations

import sys
import time
from typing import Any

from numba.core import event

#: Seconds of compiling before anything is said: less is not worth a line.
PATIENCE = 2.0
#: What users know the kernels as, by the name of the function.
NAMES = {
    "_make_state": "the learner's arrays",
    "begin": "the first actions",
    "learn": "the learning step",
    "recommend": "predictions",
    "update": "learning from given steps",
    "advance": "the filter",
}


class CompilationProgress(event.Listener):
    """
    Listens to numba. As soon as the package's kernels have compiled for ``PATIENCE`` seconds, it says so, and then what
    is compiled and how long it took.
    """

    def __init__(self) -> None:
        # The functions being compiled, the outermost first.
        self._open: list[str] = []
        self._began = 0.0
        self._spent = 0.0
        self._has_told = False
        self._is_in_line = False

    def on_start(self, event: Any) -> None:
        """
        :param event: numba begins to compile a function
        """
        function = event.data["dispatcher"].py_func
        if not self._open:
            if not str(function.__module__).startswith("sb3_knntd."):
                return
            self._began = time.perf_counter()
        self._open.append(function.__name__)
        self._tell()

    def on_end(self, event: Any) -> None:
        """
        :param event: numba has compiled a function
        """
        if not self._open:
            return
        self._tell()
        self._open.pop()
        if not self._open:
            seconds = time.perf_counter() - self._began
            self._spent += seconds
            if self._is_in_line:
                self._write(f" {seconds:.0f} s\n")
                self._is_in_line = False

    def _tell(self) -> None:
        if self._is_in_line or self._spent + time.perf_counter() - self._began < PATIENCE:
            return
        if not self._has_told:
            self._has_told = True
            self._write(
                "sb3_knntd compiles for this machine, which takes up to a minute once "
                "(python -m sb3_knntd.kernels does it ahead of time):\n"
            )
        outermost = self._open[0]
        self._is_in_line = True
        self._write(f"  {NAMES.get(outermost, outermost)} ...")

    @staticmethod
    def _write(text: str) -> None:
        # There is no standard error in some graphical programs.
        if sys.stderr is not None:
            sys.stderr.write(text)
            sys.stderr.flush()


def report_compilation() -> None:
    """Report what is compiled from now on in this process."""
    event.register("numba:compile", CompilationProgress())
