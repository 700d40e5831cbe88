"""Where the runs are done: in processes of this machine, or on a cluster, whose workers must see the same files."""

from __future__ import annotations

import logging
import multiprocessing
import os
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from lodelight.errors import ConfigError, RunError
from lodelight.fleet.jobs import Job, Outcome, Work

ATTEMPTS = 3  # processes that may die over one recording
CONNECT_S, WORKERS_S = 5.0, 30.0  # within which a scheduler must answer, and have a worker


def in_processes(jobs: Sequence[Job], work: Work, count: int) -> Iterator[Outcome]:
    """Outcomes as they come, of that many processes of this machine. A recording over which one died is tried alone."""
    waiting, tries = deque(jobs), Counter[str]()
    pool, running = _pool(count), dict[Future[Outcome], Job]()
    try:
        while waiting or running:
            suspect = bool(running) and any(tries[job.name] for job in running.values())
            while waiting and len(running) < count and not suspect and (not running or not tries[waiting[0].name]):
                job = waiting.popleft()
                running[pool.submit(work, job)] = job
                suspect = bool(tries[job.name])
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            broken = False
            for future in done:
                job = running.pop(future)
                try:
                    yield future.result()
                except BrokenProcessPool:
                    broken = True
                    tries[job.name] += 1
                    if tries[job.name] < ATTEMPTS:
                        waiting.append(job)
                    else:
                        yield Outcome(job.name, "failed", f"the process that ran it died {ATTEMPTS} times")
            if broken:
                waiting.extend(running.values())
                running.clear()
                pool.shutdown(wait=False, cancel_futures=True)
                pool = _pool(count)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _pool(count: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(count, mp_context=multiprocessing.get_context("spawn"))


def on_cluster(jobs: Sequence[Job], work: Work, address: str) -> Iterator[Outcome]:
    """Outcomes as they come, of a dask cluster, which gives the work of a worker that died to another one.

    Raises ConfigError where dask.distributed is missing or no scheduler answers, RunError where no worker is left.
    """
    try:
        import distributed
    except ImportError:
        raise ConfigError('--scheduler needs dask.distributed; pip install "lodelight[fleet]"') from None
    for name in ("distributed", "distributed.core", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = distributed.Client(address, timeout=CONNECT_S)
    except (OSError, ValueError, TimeoutError):
        raise ConfigError(
            f"no scheduler answers at {address}; start one with dask-scheduler, or leave --scheduler out to run here"
        ) from None
    with client:
        if not _has_worker(client):
            raise RunError(f"the scheduler at {address} has no worker; start some with dask-worker {address}")
        running = {client.submit(work, job, pure=False, key=f"{job.name}-{os.urandom(4).hex()}"): job for job in jobs}
        while running:
            try:
                done = distributed.wait(list(running), timeout=WORKERS_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                if not _has_worker(client):
                    raise RunError(
                        f"the scheduler at {address} has no worker left; what is finished is kept, run it again"
                    ) from None
                continue
            for future in done:
                job = running.pop(future)
                error = future.exception()
                if error is None:
                    yield future.result()
                else:
                    yield Outcome(job.name, "failed", f"its workers failed: {error}")


def _has_worker(client: Any) -> bool:
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except (OSError, TimeoutError):
        return False
    return True
