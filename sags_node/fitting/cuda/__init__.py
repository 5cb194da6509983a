"""The offline fit on a GPU."""
