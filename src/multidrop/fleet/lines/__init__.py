"""Lines: which gateway polls which line, and how a line changes its master."""
