"""Questions about the speed of polling on a line, and its cost on the host."""
