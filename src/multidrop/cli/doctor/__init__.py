"""`multidrop doctor`: checks a port, its adapter and its line."""
