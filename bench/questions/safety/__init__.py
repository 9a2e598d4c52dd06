"""Questions about wrong values, failed stops, and errors in long runs."""
