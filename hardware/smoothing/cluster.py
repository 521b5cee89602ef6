"""Sessions on a Dask cluster, one task each: an existing scheduler's, or a local one's (owns dask.distributed).

What Dask does is not done again here: it queues, sends a lost worker's task to another one, and gives up on a task
that took several workers with it. A task writes only into its session's folder and its summary last, so it can be begun
anew anywhere. All workers must reach sessions and results under the same paths.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from estimation.errors import InputError
from hardware.offline.smooth import FAILED, Cluster, Job, Outcome, smooth_job
from hardware.smoothing.run import Wishes

LOCAL = "local"
PATIENCE = 15  # s for a scheduler to answer
SPAWN = "distributed.nanny.pre-spawn-environ"
SETTINGS = {  # of workers here: Dask's own cost a third of the time of work that makes and drops many arrays
    "distributed.worker.daemon": False,  # a daemon may have no process of its own, and tracking has one
    "distributed.worker.profile.enabled": False,  # a look at all threads each 10 ms
    f"{SPAWN}.MALLOC_TRIM_THRESHOLD_": str(1 << 28),  # bytes; 64 kB go back to the system and are asked for again
    f"{SPAWN}.MALLOC_MMAP_THRESHOLD_": str(1 << 28),  # bytes; else each array of 128 kB is a mapping of its own
    f"{SPAWN}.MALLOC_ARENA_MAX": "1",  # the work is done in a thread, whose own arena is given back as eagerly
}
MISSING = "dask.distributed, by pip install 'stillbed[cluster]'"


def on_cluster(jobs: Sequence[Job], wishes: Wishes, cluster: Cluster) -> Iterator[Outcome]:
    """What became of each job, as they are done; when interrupted, what is not done is called off."""
    with ExitStack() as stack:
        address = cluster.scheduler
        if address == LOCAL:
            address = stack.enter_context(local_cluster(cluster.workers)).scheduler_address
        distributed = _library(cluster.scheduler)
        try:
            client = stack.enter_context(distributed.Client(address, timeout=PATIENCE))
        except (OSError, TimeoutError, ValueError, ImportError) as error:
            allowed = f"{LOCAL}, or the address of a running scheduler, such as tcp://host:8786 ({error})"
            raise InputError("command line", "--scheduler", cluster.scheduler, allowed) from error
        there = [Job(_anywhere(job.session), _anywhere(job.out)) for job in jobs]
        futures = [client.submit(smooth_job, job, wishes, pure=False) for job in there]
        own = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        for future in distributed.as_completed(futures):
            yield _told(own[future.key], future)


@contextmanager
def local_cluster(workers: int | None) -> Iterator[Any]:
    """A Dask cluster of this machine's processes; `workers` of them, None for as many as cores.

    A thread each: the work holds Python's lock. Nothing outside this machine can reach it.
    """
    made = _library(LOCAL).LocalCluster
    import dask  # is there where distributed is

    with (
        dask.config.set(SETTINGS),  # for as long as it stands: a worker that is started again is told by them too
        made(
            n_workers=workers,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            silence_logs="CRITICAL",
        ) as cluster,
    ):
        yield cluster


def _library(scheduler: str) -> Any:
    try:
        import distributed
    except ImportError:
        raise InputError("command line", "--scheduler", scheduler, MISSING) from None
    return distributed


def _anywhere(path: Path) -> Path:
    """The path as a worker in another folder has to write it."""
    return path.resolve()


def _told(job: Job, future: Any) -> Outcome:
    """The outcome under the paths that were asked for; a task that Dask gave up on failed with Dask's reason."""
    error = future.exception()
    if error is not None:
        return Outcome(job, FAILED, f"{type(error).__name__}: {error}", 0.0)
    found: Outcome = future.result()
    return Outcome(job, found.state, found.text, found.spent)
