"""The gateway: one process masters the lines, and browsers, brokers and masters get in through it."""
