"""Shared by the benchmarks: compiling and running programs, and printing tables."""
