"""Benchmarks: questions, players, masters and results."""
