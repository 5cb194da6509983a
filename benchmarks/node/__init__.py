"""The whole node: hosts, crowds of consumers, days of running, streams."""
