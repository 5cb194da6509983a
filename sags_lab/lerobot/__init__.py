"""Data sets in the form of LeRobot."""
