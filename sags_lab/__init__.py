"""Work on recordings with `sags_node`: archives of them, public protocols, data sets in LeRobot's form.

`sags_node` does not import it. `commands` adds its commands to `sags`.
"""
