"""Work of a fleet that kills its process; a module of its own, since every new process imports it."""

import os
import signal
from pathlib import Path

from lodelight.fleet.jobs import Job, Outcome


def die_once(job: Job) -> Outcome:
    """Kills its process the first time that it gets this job, and always where asked to."""
    mark = Path(job.out)
    if job.options.get("always") or (job.options.get("once") and not mark.exists()):
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return Outcome(job.name, "done")
