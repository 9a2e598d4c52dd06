"""What is asked, in which order and how often. Pure."""
