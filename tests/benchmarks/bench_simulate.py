"""Time that the corridor run takes to simulate: ``python tests/benchmarks/bench_simulate.py``."""

import resource
import tempfile
from pathlib import Path
from time import perf_counter, process_time

from soundmap.simulate.simulation import simulated_run

SCENE = Path(__file__).parents[2] / "configs" / "scenes" / "corridor.toml"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for what in ("first, with compilation", "second"):
            wall, cpu = perf_counter(), process_time()
            done = simulated_run(SCENE, Path(folder) / what, run="run1")
            wall, cpu = perf_counter() - wall, process_time() - cpu
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(
                f"{what}: {done.duration_s:.1f} s of log in {wall:.1f} s "
                f"({wall / done.duration_s:.2f} of its duration), CPU {cpu:.1f} s, {peak:.0f} MiB"
            )


if __name__ == "__main__":
    main()
