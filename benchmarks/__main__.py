"""`python -m benchmarks`, in a checkout: measure how fast and how good this machine is at it."""

from benchmarks.commands import engine, node, quality
from sags_node.cli.main import begin, sags_group


@sags_group
def main(verbose: bool, form: str) -> None:
    """Measure run time and error, on this machine.

    Figures that are kept stand in benchmarks/results, each with its command in benchmarks/README.md.
    """
    begin(verbose, form)


for module in (quality, node, engine):
    for name, command in vars(module).items():
        if name.startswith("bench_"):
            main.add_command(command)

if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
