"""Run time against error, over settings."""
