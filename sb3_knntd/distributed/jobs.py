"""
Run many independent jobs and store the result of each in a file, so that an interrupted run can be resumed. This module
runs them on the cores of this machine; :mod:`sb3_knntd.distributed.ray_jobs` runs them on a Ray cluster.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from filelock import FileLock, Timeout

from sb3_knntd.common.files import replace_file

#: Environment variables that limit a worker's libraries to one thread. With one worker per core, more threads would
#: only compete.
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
}
#: Name of the lock file in a folder of results.
LOCK = ".lock"
#: Attribute of a decorated function: the names passed to :func:`stored_as`.
_NAMES = "_stored_as"
#: Number of times a job is started if its worker process dies.
ATTEMPTS = 2
#: Without a terminal, progress is printed in about this many lines, and also whenever this many seconds have passed
#: since the last line.
PROGRESS_LINES = 10
PROGRESS_SECONDS = 60.0


Function = TypeVar("Function", bound=Callable[..., Any])


def stored_as(name: str, *earlier: str) -> Callable[[Function], Function]:
    """
    Decorate a function that computes jobs. Result files store this name, and a result is reused only if its name
    matches. Keep the name when the function moves to another module; change it when the function computes something
    else.

    :param name: name that its results are stored under
    :param earlier: former names; results stored under them are still reused
    :return: the decorator, which returns the function itself
    """

    def mark(function: Function) -> Function:
        function.__dict__[_NAMES] = (name, *earlier)
        return function

    return mark


class Job(NamedTuple):
    """
    A function call to run.

    :param key: unique name, also the stem of the result file: letters, digits, ``_`` and ``-``
    :param function: the function to call, picklable (importable by name), decorated with :func:`stored_as`
    :param arguments: keyword arguments, JSON-serializable
    :param fits: predicate that tells whether a value read from a file is a valid result, picklable; by default every
        value is
    """

    key: str
    function: Callable[..., Any]
    arguments: Mapping[str, Any]
    fits: Callable[[Any], bool] | None = None


class Outcome(NamedTuple):
    """
    The outcome of a job.

    :param result: the function's return value, after a round trip through JSON
    :param error: why there is no result, a traceback or a sentence; empty if there is one
    """

    result: Any = None
    error: str = ""


#: A job that has started (with ``None``) or finished (with its outcome). A backend runs jobs and yields these events.
Event = tuple[Job, Outcome | None]
Backend = Callable[[Sequence[Job]], Generator[Event, None, None]]


def run_jobs(
    jobs: Sequence[Job], folder: Path, workers: int | None = None, title: str = "", backend: Backend | None = None
) -> dict[str, Outcome]:
    """
    Run the jobs whose results are not yet in the folder, several at a time, with a progress bar on standard error.

    The outcome of each job is stored as ``key.json`` as soon as it finishes. A result of the same function
    (:func:`stored_as`) with the same arguments is read from its file; all other jobs are run, including those that
    failed before. However the program ends, all files are complete and the next call continues from them.

    :param jobs: the jobs, with distinct keys
    :param folder: folder of the outcomes, created if missing
    :param workers: number of processes; by default one for each core that this process may use
    :param title: label of the progress bar
    :param backend: runs the jobs; by default ``workers`` processes of this machine
    :return: the outcome of each job, by key, in the order of ``jobs``
    :raises ValueError: if a key is invalid or occurs twice, a function lacks :func:`stored_as`, or ``workers`` < 1
    :raises TypeError: if the arguments of a job are not JSON-serializable
    :raises OSError: if the folder is not writable, or another process runs jobs there
    """
    if workers is not None and workers < 1:
        raise ValueError(f"workers must be at least 1; got {workers}")
    descriptions = {job.key: _description(job) for job in jobs}
    if len(descriptions) < len(jobs):
        raise ValueError(f"keys must differ; got {', '.join(job.key for job in jobs)}")
    folder.mkdir(parents=True, exist_ok=True)
    with _alone_in(folder):
        return _run_jobs(jobs, descriptions, folder, workers, title, backend)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Lock the folder, so that no job runs twice. The lock of a killed process is released."""
    try:
        with FileLock(folder / LOCK, blocking=False):
            yield
    except Timeout:
        raise BlockingIOError(
            f"another process computes in {folder}. Wait for it, and the same command goes on from there; or give "
            "another folder"
        ) from None


def _run_jobs(
    jobs: Sequence[Job],
    descriptions: Mapping[str, dict[str, Any]],
    folder: Path,
    workers: int | None,
    title: str,
    backend: Backend | None,
) -> dict[str, Outcome]:
    outcomes = {
        job.key: outcome
        for job in jobs
        if (outcome := _stored_outcome(folder / f"{job.key}.json", descriptions[job.key], job))
    }
    missing = [job for job in jobs if job.key not in outcomes]
    events = run_locally(missing, workers or usable_cores()) if backend is None else backend(missing)
    running: set[str] = set()
    with _progress(title, len(jobs), len(outcomes)) as tell, closing(events):
        for job, outcome in events:
            if outcome is None:
                running.add(job.key)
                tell(None, len(running))
                continue
            running.discard(job.key)
            ending = {"error": outcome.error} if outcome.error else {"result": outcome.result}
            replace_file(folder / f"{job.key}.json", json.dumps(descriptions[job.key] | ending).encode())
            outcomes[job.key] = outcome
            tell(outcome, len(running))
    return {job.key: outcomes[job.key] for job in jobs}


def run_locally(
    jobs: Sequence[Job], workers: int, fresh: bool = False, preload: Sequence[str] = ()
) -> Generator[Event, None, None]:
    """
    Run jobs in processes of this machine. The processes end when the iterator is closed or this process dies.

    :param jobs: the jobs
    :param workers: number of processes
    :param fresh: whether to run each job in a new process, e.g. to measure its memory
    :param preload: modules that new processes have already imported, where the platform supports it
    :return: each job when it starts, and again with its outcome, in order of completion
    """
    context = _context(preload if fresh else ())
    # Nothing is sent through this pipe. Workers exit when it closes, which happens even if this process is killed.
    lifeline, holder = context.Pipe(duplex=False)
    # One process per pool, so that the death of a process identifies the job it was running.
    idle = [_new_worker(context, lifeline) for _ in range(min(workers, len(jobs)))]
    waiting = deque((job, 1) for job in jobs)
    running: dict[Future[Outcome], tuple[Job, int, ProcessPoolExecutor]] = {}
    try:
        while waiting or running:
            while waiting and idle:
                (job, attempt), worker = waiting.popleft(), idle.pop()
                with _environment(ONE_THREAD), _interrupts_held():  # the first job starts the process
                    running[worker.submit(compute, job)] = job, attempt, worker
                # Now only the worker holds the write end: if it dies while sending a result, the read end gets EOF.
                worker._result_queue._writer.close()  # type: ignore[attr-defined]
                yield job, None
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, attempt, worker = running.pop(future)
                try:
                    outcome = future.result()
                except BrokenProcessPool:
                    outcome = None
                if fresh or outcome is None:
                    worker.shutdown()
                    worker = _new_worker(context, lifeline)
                idle.append(worker)
                if outcome is not None:
                    yield job, outcome
                elif attempt < ATTEMPTS:
                    waiting.appendleft((job, attempt + 1))
                else:
                    yield job, Outcome(error=f"its process died {attempt} times: killed, or short of memory")
    finally:
        holder.close()
        for worker in [*idle, *(worker for _, _, worker in running.values())]:
            worker.shutdown(cancel_futures=True)
        lifeline.close()


def _context(preload: Sequence[str]) -> SpawnContext | ForkServerContext:
    """The start method: spawn, or forkserver with preloaded modules."""
    if not preload or "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(preload))
    return context


def usable_cores() -> int:
    """
    :return: number of cores that this process may use
    """
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _description(job: Job) -> dict[str, Any]:
    """The function and arguments of a job, after a round trip through JSON."""
    if not job.key or not all(character.isalnum() or character in "_-" for character in job.key):
        raise ValueError(f"a key must be letters, digits, '_' and '-'; got {job.key!r}")
    name = _names(job.function)[0]
    description: dict[str, Any] = json.loads(json.dumps({"function": name, "arguments": job.arguments}))
    return description


def _names(function: Callable[..., Any]) -> tuple[str, ...]:
    """The name that results of a function are stored under, and its former names."""
    names: tuple[str, ...] = getattr(function, _NAMES, ())
    if not names:
        raise ValueError(f"{function.__qualname__} must be decorated with stored_as(name) to compute jobs")
    return names


def _stored_outcome(path: Path, description: dict[str, Any], job: Job) -> Outcome | None:
    """The result in a file, if it exists and belongs to this job."""
    try:
        stored = json.loads(path.read_bytes())
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError):
        stored = None
    if isinstance(stored, dict) and "error" in stored:
        return None
    if isinstance(stored, dict) and "result" in stored:
        result = stored.pop("result")
        is_same = stored.get("function") in _names(job.function)
        if not is_same or stored | {"function": description["function"]} != description:
            return None
        if job.fits is None or job.fits(result):
            return Outcome(result)
    print(f"{path} is damaged; its job is run again", file=sys.stderr)
    return None


def _new_worker(context: SpawnContext | ForkServerContext, lifeline: Connection) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, context, _start_worker, (lifeline,))


def _start_worker(lifeline: Connection) -> None:
    # Ctrl-C is sent to all processes of the terminal. The main process decides when the workers exit.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    lifeline.poll(None)
    os._exit(1)


def compute(job: Job) -> Outcome:
    """
    Run a job in this process.

    :param job: the job
    :return: its outcome; if the function raises, the traceback is its ``error``
    """
    try:
        return Outcome(json.loads(json.dumps(job.function(**job.arguments))))
    except Exception:
        return Outcome(error=traceback.format_exc())


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_held() -> Iterator[None]:
    """Delay Ctrl-C until the block ends. A process started in it never receives Ctrl-C, not even while it starts."""
    held = False

    def hold(*_: object) -> None:
        nonlocal held
        held = True

    # The new process inherits the blocked signal. In this process, another thread may still receive it.
    blocks = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else set()
    # A handler installed outside Python (None) could not be restored, and only the main thread is interrupted.
    handler = signal.getsignal(signal.SIGINT)
    holds = handler is not None and threading.current_thread() is threading.main_thread()
    if holds:
        signal.signal(signal.SIGINT, hold)
    try:
        yield
    finally:
        if blocks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if holds:
            signal.signal(signal.SIGINT, handler)
    if held:
        signal.raise_signal(signal.SIGINT)


@contextmanager
def _progress(title: str, total: int, done: int) -> Iterator[Callable[[Outcome | None, int], None]]:
    """
    A progress bar on a terminal, otherwise a few lines of text.

    :param title: label of the progress bar
    :param total: number of jobs
    :param done: number of jobs already done
    :return: a function to call when a job starts, with ``None``, and when it finishes, with its outcome; its second
        argument is the number of running jobs
    """
    from tqdm import tqdm

    terminal, every = sys.stderr.isatty(), -(-total // PROGRESS_LINES)
    n_before, n_failed, start = done, 0, time.monotonic()
    told = start
    with tqdm(desc=title, total=total, initial=done, unit="job", disable=not terminal) as bar:

        def tell(outcome: Outcome | None, n_running: int) -> None:
            nonlocal done, n_failed, told
            if outcome is not None:
                done, n_failed = done + 1, n_failed + bool(outcome.error)
            states = [f"{n} {state}" for n, state in ((n_running, "running"), (n_failed, "failed")) if n]
            if terminal:
                bar.set_postfix_str(", ".join(states))
                bar.update(outcome is not None)
            elif outcome is not None:
                now = time.monotonic()
                if done == total or done % every == 0 or now - told >= PROGRESS_SECONDS:
                    told = now
                    left = (now - start) / (done - n_before) * (total - done)
                    words = [f"{title}: {done} of {total}", *states, f"{tqdm.format_interval(left)} left"]
                    print(", ".join(words), file=sys.stderr)

        yield tell
