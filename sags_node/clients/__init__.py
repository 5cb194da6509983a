"""Programs that use a running node, by its sockets and files alone."""
