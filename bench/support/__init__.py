"""Compiled programs and printed tables."""
