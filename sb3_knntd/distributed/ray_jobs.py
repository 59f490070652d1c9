"""Run jobs on a Ray cluster (extra ``[ray]``)."""

from __future__ import annotations

import logging
import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import ray
from ray.actor import ActorHandle
from ray.exceptions import GetTimeoutError, RayActorError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from sb3_knntd.distributed.jobs import ONE_THREAD, Event, Job, Outcome, compute

#: Number of times a job is restarted if its process or machine dies.
RETRIES = 3
#: Interval between two polls for started jobs, seconds.
LOOK_SECONDS = 1.0
GIB = 2**30


class Board:
    """Actor that collects which jobs have started, for the progress bar."""

    def __init__(self) -> None:
        self._begun: list[str] = []

    def begin(self, key: str) -> None:
        """
        :param key: key of a job that has started
        """
        self._begun.append(key)

    def begun(self, first: int) -> list[str]:
        """
        :param first: number of keys to skip: those already read
        :return: keys of the jobs that have started since
        """
        return self._begun[first:]


def compute_on_ray(job: Job, board: Any) -> Outcome:
    """
    Run a job as a Ray task.

    :param job: the job
    :param board: handle of the :class:`Board` to notify of its start
    :return: its outcome
    """
    board.begin.remote(job.key)
    return compute(job)


def connect(address: str | None = None, log_to_driver: bool = False) -> bool:
    """
    Connect this process to a Ray cluster, unless it is already connected.

    :param address: ``"auto"`` for the cluster of this machine, ``"ray://host:port"`` for a remote cluster, ``None`` for
        the one of the environment variable ``RAY_ADDRESS`` or, if unset, a new local cluster
    :param log_to_driver: whether to print the workers' output in this process
    :return: whether a new connection was made
    :raises ConnectionError: if there is no such cluster
    """
    if ray.is_initialized():
        return False
    # Without an address, Ray would connect to the cluster last started on this machine.
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    ray.init(
        address,
        include_dashboard=False if address == "local" else None,
        log_to_driver=log_to_driver,
        logging_level=logging.WARNING,
    )
    return True


@contextmanager
def connected(address: str | None = None) -> Iterator[None]:
    """
    Context manager: :func:`connect`, and disconnect at the end if a new connection was made.

    :param address: see :func:`connect`
    :raises ConnectionError: if there is no such cluster
    """
    is_ours = connect(address)
    try:
        yield
    finally:
        if is_ours:
            ray.shutdown()


def run_on_ray(
    jobs: Sequence[Job], cpus: float = 1.0, memory: float | None = None, retries: int = RETRIES
) -> Generator[Event, None, None]:
    """
    Run jobs as tasks of the connected cluster, each in its own process. This package and the jobs' dependencies must be
    installed on its machines, in the same versions.

    Results are returned to this process, so the machines need no shared disk. A job whose process or machine dies is
    restarted elsewhere; a job that raises is not. Closing the iterator stops the running jobs.

    :param jobs: the jobs
    :param cpus: CPUs that Ray reserves for each job
    :param memory: memory that Ray reserves for each job, GiB; ``None`` to reserve none
    :param retries: number of times a job is restarted if its process or machine dies
    :return: each job when it starts, and again with its outcome, in order of completion
    """
    # Keep the board on this process's node: if that node dies, so does this process.
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
    board: ActorHandle[Any] = ray.remote(Board).options(num_cpus=0, scheduling_strategy=here).remote()  # type: ignore[assignment]
    # One process per job, and one thread for its libraries.
    task = ray.remote(max_calls=1)(compute_on_ray).options(
        num_cpus=cpus,
        memory=None if memory is None else int(memory * GIB),
        max_retries=retries,
        retry_exceptions=False,
        scheduling_strategy="SPREAD",
        runtime_env={"env_vars": ONE_THREAD},
    )
    by_key = {job.key: job for job in jobs}
    running = {task.remote(job, board): job for job in jobs}
    n_known = 0
    try:
        while running:
            finished, _ = ray.wait(list(running), num_returns=len(running), timeout=LOOK_SECONDS)
            begun = _begun(board, n_known)
            n_known += len(begun)
            yield from ((by_key[key], None) for key in begun)
            for reference in finished:
                job = running.pop(reference)
                yield job, _outcome(reference)
    finally:
        for reference in running:
            ray.cancel(reference, force=True)
        ray.kill(board)


def _begun(board: ActorHandle[Any], n_known: int) -> list[str]:
    try:
        return list(ray.get(board.begun.remote(n_known), timeout=LOOK_SECONDS))
    except (GetTimeoutError, RayActorError):  # only the progress bar depends on it
        return []


def _outcome(reference: ray.ObjectRef[Outcome]) -> Outcome:
    try:
        return ray.get(reference)
    except RayError as error:
        return Outcome(error=f"{type(error).__name__}: {error}")
