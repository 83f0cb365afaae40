"""train.py, with clocks that count the CPU time of the process instead of the time of day.

    python benchmarks/cpu_clock.py KEY=VALUE ...

With one thread the budget and all seconds are those of one core to itself, whatever else the
machine does.
"""

import runpy
import time
from pathlib import Path

time.perf_counter = time.process_time

if __name__ == "__main__":
    runpy.run_path(str(Path(__file__).resolve().parents[1] / "train.py"), run_name="__main__")
