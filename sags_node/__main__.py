"""`python -m sags_node` is the `sags` command."""

from sags_node.cli import main

main()
