"""`multidrop poll`: polls a plant's drives and records them."""
