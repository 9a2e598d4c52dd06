"""Which gateway polls which line: ownership, shares and hand-over."""
