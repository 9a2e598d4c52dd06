"""Planning: requests, their order and rates, and a line's predicted performance. No I/O, no clock."""
