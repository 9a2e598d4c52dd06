"""Benchmarks: questions (scripts), players (simulated lines), masters under test, and results."""
