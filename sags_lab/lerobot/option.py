"""`--lerobot-version`."""

import click

version_option = click.option(
    "--lerobot-version",
    type=click.Choice(("v3.0", "v2.1")),
    default="v3.0",
    show_default=True,
    help="Form of the LeRobot data set.",
)
