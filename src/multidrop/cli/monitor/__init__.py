"""`multidrop monitor`: shows a plant's drives live on a terminal."""
