"""The plant file."""
