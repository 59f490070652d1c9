"""
Many independent jobs, each with its result in a file, so that what was interrupted goes on where it was. Here they are
computed on the cores of this machine; :mod:`sb3_knntd.distributed.ray_jobs` has other machines compute them.
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

#: What keeps a worker's libraries to one thread: with a worker a core, more would only wait for each other.
ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR", "NUMBA")
}
#: What is locked in a folder where jobs are computed.
LOCK = ".lock"
#: Attribute of a function: the names that :func:`stored_as` was given.
_NAMES = "_stored_as"
#: How often a job is begun whose worker process dies.
ATTEMPTS = 2
#: Where there is no terminal, progress is told in so many lines, and when so many seconds have passed since the last.
PROGRESS_LINES = 10
PROGRESS_SECONDS = 60.0


Function = TypeVar("Function", bound=Callable[..., Any])


def stored_as(name: str, *earlier: str) -> Callable[[Function], Function]:
    """
    Decorate a function that computes jobs. Files of results name the function, and a result counts as computed only
    under this name; so it stays the same when the function moves to another module, and changes when the function
    computes something else.

    :param name: what its results are stored under
    :param earlier: what they were stored under before; such results still count
    :return: the decorator, which returns the function itself
    """

    def mark(function: Function) -> Function:
        function.__dict__[_NAMES] = (name, *earlier)
        return function

    return mark


class Job(NamedTuple):
    """
    Something to compute.

    :param key: its name, and that of its file: letters, digits, ``_`` and ``-``
    :param function: what computes it, a function that can be imported by its name, decorated with :func:`stored_as`
    :param arguments: keyword arguments, of what JSON can hold
    :param fits: whether something that is read from a file can be its result, a function that can be imported by its
        name; by default anything can
    """

    key: str
    function: Callable[..., Any]
    arguments: Mapping[str, Any]
    fits: Callable[[Any], bool] | None = None


class Outcome(NamedTuple):
    """
    What became of a job.

    :param result: what its function returned, as JSON gives it back
    :param error: why there is no result, a traceback or a sentence; empty if there is one
    """

    result: Any = None
    error: str = ""


#: What computes jobs: it tells of each when it begins, with ``None``, and when it has come to its end.
Event = tuple[Job, Outcome | None]
Backend = Callable[[Sequence[Job]], Generator[Event, None, None]]


def run_jobs(
    jobs: Sequence[Job], folder: Path, workers: int | None = None, title: str = "", backend: Backend | None = None
) -> dict[str, Outcome]:
    """
    Compute what is not yet in the folder, several jobs at a time, with a progress bar on standard error.

    The outcome of each job is stored as ``key.json`` as soon as there is one. A result that was computed by the same
    function (:func:`stored_as`) from the same arguments is read from its file; everything else is computed, also what
    failed before. Whatever ends the program, all files are complete, and the next call continues from them.

    :param jobs: what to compute, keys all different
    :param folder: where outcomes are; made if it is not there
    :param workers: number of processes; by default one for each core that this process may use
    :param title: what the progress is of
    :param backend: what computes them; by default so many processes of this machine
    :return: the outcome of each job, by key, in the order of ``jobs``
    :raises ValueError: if a key is no file name or there twice, a function has no :func:`stored_as`, or ``workers`` < 1
    :raises TypeError: if JSON cannot hold the arguments of a job
    :raises OSError: if the folder cannot be written to, or another process computes there
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
    """Nothing is computed twice; a lock of a process that is killed is gone."""
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
    Compute jobs in processes of this machine. If the iterator is closed, or this process dies, so do they.

    :param jobs: what to compute
    :param workers: number of processes
    :param fresh: whether each job gets a process of its own, as it must where memory is measured
    :param preload: modules that fresh processes find imported, where the system can do that
    :return: each job when it begins, and with its outcome in the order in which they come to their end
    """
    context = _context(preload if fresh else ())
    # Nothing is ever sent. Workers end when it closes, which it does even if this process is killed.
    lifeline, holder = context.Pipe(duplex=False)
    # One process each: if it dies, that tells which job it died of.
    idle = [_new_worker(context, lifeline) for _ in range(min(workers, len(jobs)))]
    waiting = deque((job, 1) for job in jobs)
    running: dict[Future[Outcome], tuple[Job, int, ProcessPoolExecutor]] = {}
    try:
        while waiting or running:
            while waiting and idle:
                (job, attempt), worker = waiting.popleft(), idle.pop()
                with _environment(ONE_THREAD), _interrupts_held():  # a worker starts with its first job
                    running[worker.submit(compute, job)] = job, attempt, worker
                # The worker alone has the other end now: if it dies in the middle of an answer, that is its end.
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
    """How processes are started: anew, or from one that has imported what they need."""
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
    """What its outcome depends on, as JSON gives it back."""
    if not job.key or not all(character.isalnum() or character in "_-" for character in job.key):
        raise ValueError(f"a key must be letters, digits, '_' and '-'; got {job.key!r}")
    name = _names(job.function)[0]
    description: dict[str, Any] = json.loads(json.dumps({"function": name, "arguments": job.arguments}))
    return description


def _names(function: Callable[..., Any]) -> tuple[str, ...]:
    """What results of a function are stored under, and were before."""
    names: tuple[str, ...] = getattr(function, _NAMES, ())
    if not names:
        raise ValueError(f"{function.__qualname__} must be decorated with stored_as(name) to compute jobs")
    return names


def _stored_outcome(path: Path, description: dict[str, Any], job: Job) -> Outcome | None:
    """The result in a file, if it is there and of just this job."""
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
    print(f"{path} is damaged, and its job is computed anew", file=sys.stderr)
    return None


def _new_worker(context: SpawnContext | ForkServerContext, lifeline: Connection) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, context, _start_worker, (lifeline,))


def _start_worker(lifeline: Connection) -> None:
    # Ctrl-C goes to all processes of a terminal. What is to become of the workers the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), daemon=True).start()


def _end_with(lifeline: Connection) -> None:
    lifeline.poll(None)
    os._exit(1)


def compute(job: Job) -> Outcome:
    """
    :param job: what to compute, here and now
    :return: its outcome; what its function raises is the reason why there is no result
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
    """Ctrl-C comes afterwards; to a process that is started meanwhile never, not even before it can ask not to."""
    held = False

    def hold(*_: object) -> None:
        nonlocal held
        held = True

    # Blocking is for the process that is started, which inherits it. Here the signal finds a thread that does not.
    blocks = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if blocks else set()
    # What was set outside of Python could not be set again, and other threads are not interrupted.
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
    A progress bar on a terminal, else some lines.

    :param title: what is in progress
    :param total: number of jobs
    :param done: number of those that were there already
    :return: what to call for each job when it begins, with ``None``, and when it has come to its end, with its outcome;
        and both times with how many are running now
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
