"""What keeps a line busy."""
