"""Many recordings, on one machine or on many: a list of them, a task for each, one table of all results."""
