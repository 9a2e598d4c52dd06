"""Polling: jobs of a line, their turn on its port, registers that are refused, and batches of rows."""
