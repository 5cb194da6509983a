"""`python -m benchmarks`, in a checkout: measure how fast and how good this machine is at it."""

from __future__ import annotations

from benchmarks.commands.depth import (
    bench_depth,
)
from benchmarks.commands.disturbances import (
    bench_disturbances,
)
from benchmarks.commands.engine import (
    bench_ablation,
    bench_alias,
    bench_gpu,
    bench_kernels,
    bench_methods,
)
from benchmarks.commands.masks import (
    bench_masks,
)
from benchmarks.commands.node import (
    bench_bridges,
    bench_crowd,
    bench_endurance,
    bench_inputs,
    bench_pareto,
    bench_recall,
    bench_scope,
    bench_soak,
    bench_thin,
    bench_tracking,
    bench_transport,
)
from benchmarks.commands.registration import bench_registration
from sags_node.cli.main import begin, sags_group


@sags_group
def main(verbose: bool, form: str) -> None:
    """Measure run time and error, on this machine.

    Figures that are kept stand in benchmarks/results, each with its command in benchmarks/README.md.
    """
    begin(verbose, form)


for command in (
    bench_depth,
    bench_masks,
    bench_registration,
    bench_disturbances,
    bench_pareto,
    bench_endurance,
    bench_soak,
    bench_tracking,
    bench_recall,
    bench_scope,
    bench_crowd,
    bench_bridges,
    bench_transport,
    bench_thin,
    bench_inputs,
    bench_kernels,
    bench_gpu,
    bench_alias,
    bench_methods,
    bench_ablation,
):
    main.add_command(command)

if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
