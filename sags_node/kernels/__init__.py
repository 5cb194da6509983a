"""What every compiled kernel of the package stands on: its compiler's options and its threads."""
