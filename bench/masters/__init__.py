"""Masters: multidrop, its rivals, and bare programs in C."""
