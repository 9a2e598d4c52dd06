"""Planning: requests, their order and rates, and the predicted performance of a line. No I/O, no clock."""
