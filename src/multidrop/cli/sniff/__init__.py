"""`multidrop sniff`: listens to a line that another master polls."""
