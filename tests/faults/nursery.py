"""Starts runs by forking, so that forty processes need not load torch forty times.

Reads one JSON object per line: ``config``, ``folder``, ``resume``, ``log`` and, if wanted,
``file_limit`` (bytes) and ``clock`` (seconds by which the wall clock jumps at every reading).
Answers with 0 once it is ready, then with the process id and, once the run has ended, with its
exit status.
"""

import json
import os
import resource
import sys
import time
import warnings
from pathlib import Path
from typing import Any

# Here, and not by each run: a second one must meet the first while it trains.
from tests.warm import VIDEO_FRAMES
from xplanes.run import KNOWN_ERRORS, run
from xplanes.synthetic.demo import write


def run_one(job: dict[str, Any]) -> int:
    """A run as train.py makes it, its output in a file."""
    output = os.open(job["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    if job.get("file_limit"):
        resource.setrlimit(resource.RLIMIT_FSIZE, (job["file_limit"],) * 2)
    if job.get("clock"):
        jump(job["clock"])
    try:
        run(job["config"], Path(job["folder"]), [], resume=job["resume"])
    except KNOWN_ERRORS as error:
        print(f"error: {error}", flush=True)
        return 1
    return 0


def jump(seconds: float) -> None:
    """Let the wall clock go back, or leap on, at every reading."""
    real, readings = time.time, [0]

    def jumping() -> float:
        readings[0] += 1
        return real() + readings[0] * seconds

    time.time = jumping


def main() -> None:
    """Fork a run per line; a parent that has started no threads may."""
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    import torch.utils.tensorboard.writer

    write.VIDEO_FRAMES = VIDEO_FRAMES
    print(0, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if not child:
            status = 70
            try:
                status = run_one(job)
            except BaseException:
                import traceback

                traceback.print_exc()
            finally:
                sys.stdout.flush()
                os._exit(status)
        print(child, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    main()
