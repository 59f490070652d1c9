"""Functions for the jobs of the tests, importable by worker processes."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sb3_knntd.distributed.jobs import stored_as


@stored_as("job_functions.square")
def square(number: int, log: str) -> dict[str, Any]:
    """Append a line to the log at each call."""
    with open(log, "a") as file:
        file.write(f"{number}\n")
    return {"square": number**2, "pair": (number, number)}


@stored_as("job_functions.threads")
def threads() -> dict[str, Any]:
    """The numbers of threads of the libraries, and the process."""
    import torch

    return {"torch": torch.get_num_threads(), "openmp": os.environ["OMP_NUM_THREADS"], "process": os.getpid()}


@stored_as("job_functions.fail")
def fail(what: str) -> None:
    """Raise."""
    raise ValueError(f"there is no {what}")


@stored_as("job_functions.unstorable")
def unstorable() -> object:
    """Return a value that JSON cannot represent."""
    return object()


@stored_as("job_functions.die")
def die(marker: str, times: int) -> str:
    """Kill the own process a number of times, then return."""
    path = Path(marker)
    attempts = int(path.read_text()) if path.exists() else 0
    path.write_text(str(attempts + 1))
    if attempts < times:
        os.kill(os.getpid(), signal.SIGKILL)
    return f"alive after {attempts}"


@stored_as("job_functions.slow")
def slow(seconds: float, folder: str) -> int:
    """Report the process, and sleep."""
    Path(folder, f"started-{os.getpid()}").touch()
    time.sleep(seconds)
    return os.getpid()


@stored_as("job_functions.die_while_answering")
def die_while_answering(marker: str, times: int) -> str:
    """Kill the own process a number of times while a large result is being sent, then return it."""
    path = Path(marker)
    attempts = int(path.read_text()) if path.exists() else 0
    path.write_text(str(attempts + 1))
    if attempts < times:
        Connection._send = _send_half  # type: ignore[method-assign]
    return "x" * 10**6


def _send_half(connection: Connection, content: Any) -> None:
    os.write(connection.fileno(), bytes(content)[: len(content) // 2])
    os._exit(1)
