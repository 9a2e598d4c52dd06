"""`multidrop check`: says what a family's file declares, what it leaves open, and what will be refused."""
