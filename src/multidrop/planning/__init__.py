"""Planning: requests, their order and rates, and what a line will reach. No I/O, no clock."""
