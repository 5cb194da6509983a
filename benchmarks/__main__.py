"""`python -m benchmarks`, in a checkout: measure run time and error on this machine."""

from benchmarks.commands import engine, node, quality
from sags_node.cli.main import begin, sags_group


@sags_group
def main(verbose: bool, form: str) -> None:
    """Measure run time and error, on this machine.

    Kept figures are in benchmarks/results; `provenance` in each file has the command that made it.
    """
    begin(verbose, form)


for module in (quality, node, engine):
    for name, command in vars(module).items():
        if name.startswith("bench_"):
            main.add_command(command)

if __name__ == "__main__":
    main(prog_name="python -m benchmarks")
