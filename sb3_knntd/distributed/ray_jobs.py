"""Jobs on the machines of a Ray cluster (extra ``[ray]``)."""

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

#: How often a job is begun again whose process or machine dies.
RETRIES = 3
#: Seconds between two looks at which jobs have begun.
LOOK_SECONDS = 1.0
GIB = 2**30


class Board:
    """Where jobs say that they have begun; only for display."""

    def __init__(self) -> None:
        self._begun: list[str] = []

    def begin(self, key: str) -> None:
        """
        :param key: of a job
        """
        self._begun.append(key)

    def begun(self, first: int) -> list[str]:
        """
        :param first: how many are known already
        :return: keys of the jobs that have begun since
        """
        return self._begun[first:]


def compute_on_ray(job: Job, board: Any) -> Outcome:
    """
    :param job: what to compute, on whichever machine this runs
    :param board: handle of the :class:`Board` where to say that it has begun
    :return: its outcome
    """
    board.begin.remote(job.key)
    return compute(job)


def connect(address: str | None = None, log_to_driver: bool = False) -> bool:
    """
    Connect this process to a cluster; whoever is connected already stays so.

    :param address: ``"auto"`` for the cluster that this machine belongs to, ``"ray://host:port"`` for one elsewhere,
        ``None`` for that of ``RAY_ADDRESS``, or else one of this machine alone
    :param log_to_driver: whether what is printed elsewhere is shown here
    :return: whether it was not connected before
    :raises ConnectionError: if there is no such cluster
    """
    if ray.is_initialized():
        return False
    # Given nothing, Ray itself would take whichever cluster was started last on this machine.
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
    Be connected to a cluster for as long as this lasts; whoever is connected already stays so.

    :param address: as :func:`connect` takes it
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
    Compute jobs as tasks of the cluster that this process is connected to, each in a process of its own. The package,
    and what the jobs need besides, must be installed on its machines, in the same versions.

    Results come back to this process, so that machines need share no disk. A job whose process or machine dies is begun
    again elsewhere; one that raises is not. If the iterator is closed, what is running is stopped.

    :param jobs: what to compute
    :param cpus: CPUs that Ray reserves for each job
    :param memory: GiB that it reserves for each, ``None`` for none
    :param retries: how often a job is begun again whose process or machine dies
    :return: each job when it begins, and with its outcome in the order in which they come to their end
    """
    # Where this process runs no node dies without it.
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=True)
    board: ActorHandle[Any] = ray.remote(Board).options(num_cpus=0, scheduling_strategy=here).remote()  # type: ignore[assignment]
    # A process serves one job, and its libraries have one thread.
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
    except (GetTimeoutError, RayActorError):  # without it only the display knows less
        return []


def _outcome(reference: ray.ObjectRef[Outcome]) -> Outcome:
    try:
        return ray.get(reference)
    except RayError as error:
        return Outcome(error=f"{type(error).__name__}: {error}")
